"""Zaber stages over the ASCII protocol: several devices on one chain, several axes on a device."""
