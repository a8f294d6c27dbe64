"""The two errors that a user is meant to see."""

from wavequake.words import plain

_MOST_LINES = 1000


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


class NoWorkersError(UserError):
    """Worker processes do not start here."""
