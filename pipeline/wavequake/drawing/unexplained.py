"""Matplotlib without the help texts that it writes when it loads."""


def leave_help_out() -> None:
    """Have matplotlib, if it is not loaded yet, write no help for the `set` of each of its classes.

    That goes through all methods of a hundred classes, a third of the time to load it, and nobody reads it in
    a command. Where matplotlib does it otherwise, nothing changes.
    """
    from matplotlib.artist import Artist

    if hasattr(Artist, "_update_set_signature_and_docstring"):
        Artist._update_set_signature_and_docstring = classmethod(lambda cls: None)
