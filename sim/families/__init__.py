"""Families of linear models: responses of the tissue to unit forces."""
