"""Basler cameras through pylon, Basler's own library."""
