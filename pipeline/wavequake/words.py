"""Words for numbers of things."""


def counted(number: int, noun: str) -> str:
    """Return a number and its noun: 1 case, 2 cases.

    Examples
    --------
    >>> counted(1, "leftover file"), counted(0, "case")
    ('1 leftover file', '0 cases')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def are(number: int, noun: str) -> str:
    """Return the same with a verb: 1 case is, 2 cases are."""
    return f"{counted(number, noun)} {'is' if number == 1 else 'are'}"
