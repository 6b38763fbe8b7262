"""Files: images, calibrations, versioned records, figures."""
