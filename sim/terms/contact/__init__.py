"""What touches: rigid tools, and the skull."""
