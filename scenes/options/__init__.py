"""Options that several commands declare, and construction of the requested objects."""
