"""Host checks, round trips and metrics."""
