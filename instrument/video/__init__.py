"""Reconstructed videos: from a recording to OME-Zarr and MP4, on one machine or many."""
