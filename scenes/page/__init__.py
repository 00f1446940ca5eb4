"""Demo page: display, deformers and requests."""
