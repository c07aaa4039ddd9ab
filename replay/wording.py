"""Numbers with their nouns in messages: as twin_core.wording, which the replayer does not import."""


def counted(number: int, one: str, many: str = "") -> str:
    """Return a number and what it counts, singular or plural: ``many`` where that is more than ``one`` and an s.

    Examples
    --------
    >>> counted(1, "row repeats", "rows repeat"), counted(2, "row repeats", "rows repeat"), counted(0, "node")
    ('1 row repeats', '2 rows repeat', '0 nodes')
    """
    return f"{number} {one if number == 1 else many or f'{one}s'}"
