"""What was learnt about tissue: data sets, regressors, and deformers made of them."""
