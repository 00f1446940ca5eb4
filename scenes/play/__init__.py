"""The loop that plays a scene, the page, checks and episodes."""
