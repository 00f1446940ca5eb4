"""Location of the tumour from observations of the brain's surface: causes, ensemble, prior and posterior."""
