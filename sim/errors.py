"""Exception class for errors that a user can correct."""


class InputError(ValueError):
    """Error for invalid input; its message gives the value, the reason and the remedy."""
