"""Training of models from a data set."""
