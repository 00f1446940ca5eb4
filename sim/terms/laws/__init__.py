"""Material laws, one per file."""
