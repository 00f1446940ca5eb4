"""Contact with rigid tools and with the skull."""
