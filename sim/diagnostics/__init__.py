"""Checks of a solution beyond equilibrium: traction on the bond, tissue that passes the skull, excessive strain."""
