"""Export of a scene with a fast model as one HTML file that needs no server."""
