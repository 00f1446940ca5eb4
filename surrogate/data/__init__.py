"""Data sets: sampled loads, their FEM results, and the files that store both."""
