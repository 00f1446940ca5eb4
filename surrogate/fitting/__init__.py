"""What tissue a patient has, from what is seen of the open cortex in several frames."""
