"""Recordings, replay and the black box."""
