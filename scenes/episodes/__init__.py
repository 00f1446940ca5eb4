"""Data sets of simulated surgery: plans, episodes that are sampled from plans, exports and readers."""
