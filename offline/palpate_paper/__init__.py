"""Studies that a reader can rerun: what the methods do, as tables and pictures."""
