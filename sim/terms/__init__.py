"""One file per effect and law: its Warp functions, kernels and host class."""
