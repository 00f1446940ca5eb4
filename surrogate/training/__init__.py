"""Training of models from a data set, with their scores and bounds."""
