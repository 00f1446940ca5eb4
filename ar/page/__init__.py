"""Browser page: its parts, its clients, and the messages that clients may send."""
