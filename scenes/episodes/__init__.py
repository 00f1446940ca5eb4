"""Data sets: plans, episodes drawn from them, and what reads them."""
