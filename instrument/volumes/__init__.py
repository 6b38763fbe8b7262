"""Volumes on disk: where their voxels lie, written and read plane by plane."""
