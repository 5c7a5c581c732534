"""From an assembled body to a model of its surface: modes, residual flexibility, and how large the error is."""
