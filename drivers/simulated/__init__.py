"""The simulated bench: the embedded default, shown everywhere as SIMULATED."""
