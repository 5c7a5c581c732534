"""Why a system can't be reduced as asked."""


class ReductionError(ValueError):
    """A system can't be reduced as asked; the message says why."""
