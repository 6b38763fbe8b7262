"""What keeps a photograph from being explained by light through its PSF, looked for and mended."""
