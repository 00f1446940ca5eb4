"""Live poses in and answers out by OpenIGTLink: its messages, a server of many clients, and what is answered."""
