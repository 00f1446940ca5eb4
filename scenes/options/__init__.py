"""Command-line options that several commands share, and construction of the requested objects."""
