"""What a user can put right: one exception whose text is a sentence."""


class InputError(ValueError):
    """Input that cannot be used. The text names the thing, the reason and the remedy."""
