"""Numbers only: optics, operators, priors, solvers, analysis. Knows no device, no file format, no window."""
