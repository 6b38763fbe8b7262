"""Activity in videos: baseline, relative change, regions and their courses."""

from recon.activity.baseline import Motion, aligned, baseline, change, motion
from recon.activity.regions import Region, find_regions, local_correlation

__all__ = [
    "Motion",
    "Region",
    "aligned",
    "baseline",
    "change",
    "find_regions",
    "local_correlation",
    "motion",
]
