"""Sampled loads, their FEM results, and the files that store both."""
