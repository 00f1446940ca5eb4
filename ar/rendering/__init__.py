"""From surfaces and a camera to a lit picture."""
