"""Where the tumour is, from what is seen of the brain: causes, their ensemble, and what an observation says."""
