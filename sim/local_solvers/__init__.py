"""What one load strains or touches most, solved by itself: nonlinear elimination and contact."""
