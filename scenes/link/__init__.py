"""OpenIGTLink: live poses in, results out; messages, a server of many clients, and the computation of results."""
