"""Checks of an equilibrium: traction on the bond to the skull, tissue that passes the skull, excessive strain."""
