"""The two errors that a user is meant to see."""

import re

LONGEST = 600
_MOST_LINES = 1000
# Control characters, among them line ends and what terminals obey, and marks that turn the direction of text.
_UNSEEN = re.compile("[\0-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff]+")


def plain(message: object) -> str:
    """Return a message in one line without unseen characters; where it is longer than LONGEST, its ends."""
    text = _UNSEEN.sub(" ", str(message))
    return text if len(text) <= LONGEST else f"{text[:400]} ... {text[-(LONGEST - 405) :]}"


class UserError(Exception):
    """Bad input: one sentence that says what is wrong, where, and what would be right (exit code 2).

    What it quotes from files and names is made `plain`; ``details`` are lines to show below it, each plain.
    """

    def __init__(self, message: object, details: str = "") -> None:
        super().__init__(plain(message))
        self.details = "\n".join(map(plain, details.split("\n")[:_MOST_LINES]))


class StoreDamageError(Exception):
    """A store that is incomplete or damaged: one sentence that names the chunks (exit code 4)."""

    def __init__(self, message: object) -> None:
        super().__init__(plain(message))
