"""Discretisations other than finite elements."""
