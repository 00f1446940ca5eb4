"""Material laws, one law per module."""
