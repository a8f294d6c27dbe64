"""The two errors that a user is meant to see."""


class UserError(Exception):
    """Bad input: one sentence that says what is wrong, where, and what would be right (exit code 2)."""


class StoreDamageError(Exception):
    """A store that is incomplete or damaged: one sentence that names the chunks (exit code 4)."""
