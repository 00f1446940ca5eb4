"""Which solver is tried, in which order; load steps, time steps and live frames."""
