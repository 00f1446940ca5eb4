"""Browser page: its parts, its clients, and the messages that they may send."""
