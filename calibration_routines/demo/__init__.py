"""The demo: calibrate, photograph, reconstruct on the simulated bench."""
