"""What an answer says of itself beside its motion: tractions on the bond, tissue that passes the skull."""
