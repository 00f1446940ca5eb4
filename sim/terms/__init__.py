"""Energy terms, one file per effect or material law: Warp functions, kernels and host class."""
