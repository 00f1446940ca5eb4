"""Data sets: plans, episodes sampled from them, and readers."""
