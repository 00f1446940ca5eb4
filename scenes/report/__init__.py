"""The report: what accuracy costs in time."""
