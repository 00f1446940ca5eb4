"""Options that several commands declare, and what commands read from and write by them."""
