"""Host checks, round trips, metrics and the simulated device."""
