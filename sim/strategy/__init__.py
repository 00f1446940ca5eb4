"""Selection of solvers, load steps, time steps, and frames of a live tool."""
