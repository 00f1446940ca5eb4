"""Solver selection, load steps, time steps and live frames."""
