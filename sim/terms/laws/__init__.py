"""One file per tissue law."""
