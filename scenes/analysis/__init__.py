"""Cost of accuracy, errors of the tumour, and other effects that move it."""
