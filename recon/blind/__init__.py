"""Calibration without a point source: from beads at unknown places (Kuo 2020, sec. 5.4), known pictures."""

from recon.blind.alternate import BlindResult, BlindSettings, calibrate_from_beads
from recon.blind.known_pictures import PicturePsf, PictureSettings, psf_from_pictures
from recon.camera.points import Points

__all__ = [
    "BlindResult",
    "BlindSettings",
    "PicturePsf",
    "PictureSettings",
    "Points",
    "calibrate_from_beads",
    "psf_from_pictures",
]
