"""Activity in videos: baseline, relative change, regions and their courses."""

from recon.activity.baseline import Motion, aligned, baseline, change, fading, motion
from recon.activity.regions import Region, find_regions, local_correlation

__all__ = [
    "Motion",
    "Region",
    "aligned",
    "baseline",
    "change",
    "fading",
    "find_regions",
    "local_correlation",
    "motion",
]
