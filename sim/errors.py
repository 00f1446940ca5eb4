"""Exception for errors that a user can correct."""


class InputError(ValueError):
    """Invalid input; the text gives the value, the reason and the remedy."""
