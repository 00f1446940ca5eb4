"""Energy terms, one module per effect or material law, with Warp functions, kernels and a host class."""
