"""Tumour position from observations of the brain's surface: causes, their ensemble, prior and posterior."""
