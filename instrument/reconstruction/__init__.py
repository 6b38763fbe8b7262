"""Reconstruction requests: from files to a result with its record."""
