"""Hologram requests, files and figures."""
