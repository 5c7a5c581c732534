"""Run a reduced tissue model at 1 kHz: displacements in, reaction forces out, over Zenoh."""
