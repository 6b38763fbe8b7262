"""Compressive calibration: PSFs over the field from a few images of beads at unknown places (sec. 5.4)."""

from recon.blind.alternate import BlindResult, BlindSettings, calibrate_from_beads
from recon.blind.points import Points

__all__ = ["BlindResult", "BlindSettings", "Points", "calibrate_from_beads"]
