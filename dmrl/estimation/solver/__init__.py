"""Factor solver of a flight: residuals, robust losses, marginals and noise selection."""
