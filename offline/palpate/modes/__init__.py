"""Elastic modes of a supported body."""
