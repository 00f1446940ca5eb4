"""Figures of the performance pages: their measurements, records, tables and comparison."""
