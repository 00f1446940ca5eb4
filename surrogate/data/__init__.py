"""Loads that are drawn, the answers to them, and the files that keep both."""
