"""Options that several commands declare, and the objects that they ask for."""
