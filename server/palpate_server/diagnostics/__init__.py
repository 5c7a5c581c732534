"""Programs that measure a machine or watch a server: check-host, round trips, metrics; and a model for them to run."""
