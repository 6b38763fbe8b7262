"""Newport SMC100 controllers."""
