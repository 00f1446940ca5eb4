"""Figures of the performance pages: their benches, records, tables and comparison."""
