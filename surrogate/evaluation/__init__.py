"""How far off models are, and whether they keep what they promise."""
