"""PSF sweeps: plan, exposures, quality, analysis, record."""
