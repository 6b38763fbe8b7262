"""Thorlabs Elliptec modules (ELLx protocol)."""
