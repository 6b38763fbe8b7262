"""What everything in recon stands on: array namespace, FFT, threads, noise, metrics, checks."""
