"""From a data set to models."""
