"""Studies of the methods that a reader can rerun, as tables and pictures."""
