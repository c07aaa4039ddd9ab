"""What the store says of a twin that was deleted meanwhile."""


class TwinGone(LookupError):
    """The twin that a write concerns was deleted."""
