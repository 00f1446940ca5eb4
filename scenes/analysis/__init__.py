"""What accuracy costs, and what else moves the tumour."""
