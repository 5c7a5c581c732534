"""Scenes that ship with palpate: geometry, material, contacts and reduction, one TOML file each."""
