"""Run a reduced tissue model at 1 kHz: tool positions in, forces out, over Zenoh."""
