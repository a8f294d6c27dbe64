"""Words for numbers of things, and words of others made fit to be shown: the one place that does so."""

import re

MOST = 1000  # characters of a message: more than any of our own

# What terminals obey instead of showing it, what turns the direction of text, and what no file can hold:
# control characters but line feed and tab, bidirectional marks, separators of lines, halves of characters,
# marks of byte order.
_OBEYED = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff]"
)
_SENTENCES = re.compile(r"(?<=[.:]) (?=[A-Z])")
_BREAKS = re.compile(r"[\t\n\r]++ *+")


def printable(text: str) -> str:
    r"""Return a text in which characters that terminals obey are written as escapes.

    Examples
    --------
    >>> print(printable("a" + chr(27) + "[2Jb" + chr(0x202E)))
    a\x1b[2Jb\u202e
    """
    return _OBEYED.sub(lambda found: ascii(found[0])[1:-1], text)


def shortened(text: str, most: int = MOST) -> str:
    """Return a text of at most `most` characters; of a longer one words of the middle are left out.

    Examples
    --------
    >>> shortened("what is wrong, in many words, and what would be right", 40)
    'what is wrong, ... would be right'
    """
    if len(text) <= most:
        return text
    last = most // 2
    first = most - last - 5
    head, tail = text[:first], text[-last:]
    if not text[first].isspace() and head.rfind(" ") > first // 2:
        head = head[: head.rfind(" ")]
    if not text[-last - 1].isspace() and 0 <= tail.find(" ") < last // 2:
        tail = tail[tail.find(" ") + 1 :]
    return f"{head} ... {tail}"


def plain(message: object) -> str:
    r"""Return a message as one printable line of at most `MOST` characters.

    Examples
    --------
    >>> print(plain("two\n  lines" + chr(27)))
    two lines\x1b
    """
    return shortened(printable(_BREAKS.sub(" ", str(message))))


def unsaid(text: str, said: str) -> str:
    """Return a text without the sentences that were said already.

    Examples
    --------
    >>> unsaid("A is best. Over 3 cases. B is e.g. worst.", "A is best. B is e.g. worst.")
    'Over 3 cases.'
    """
    known, words = " ".join(said.split()), " ".join(text.split())
    if known:
        words = words.replace(known, "")
    sentences = (one.strip() for one in _SENTENCES.split(words))
    return " ".join(one for one in sentences if one and one not in known)


def counted(number: int, noun: str) -> str:
    """Return a number and its noun: 1 case, 2 cases.

    Examples
    --------
    >>> counted(1, "leftover file"), counted(0, "case")
    ('1 leftover file', '0 cases')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def lasting(seconds: float) -> str:
    """Return a time in the unit that suits it.

    Examples
    --------
    >>> lasting(0.1714), lasting(9.592), lasting(12345.6)
    ('171 ms', '9.59 s', '12346 s')
    """
    if seconds >= 1e3:
        return f"{seconds:.0f} s"
    return f"{seconds * 1e3:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"


def sized(size: float) -> str:
    """Return a number of bytes in the unit that suits it.

    Examples
    --------
    >>> sized(34), sized(2940), sized(1.23e7), sized(4.1e12)
    ('34 B', '2.9 kB', '12.3 MB', '4100.0 GB')
    """
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}"
    return f"{size:.0f} B"


def are(number: int, noun: str) -> str:
    """Return the same with a verb: 1 case is, 2 cases are."""
    return f"{counted(number, noun)} {'is' if number == 1 else 'are'}"
