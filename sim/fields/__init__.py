"""A body's displacement on a grid: within it, smoothly round it, and the other way."""
