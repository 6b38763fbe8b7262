"""Holograms through a scattering mask (Kuo 2020, Ch. 7 and A.4): model, losses, optimisers, étendue.

In short::

    display = Display((540, 960), random_mask((2160, 3840)))
    model = HologramModel(display, [Target(image)], HologramOptions(loss="frequency"))
    hologram = compute_hologram(model)
    print(judge(hologram.slm, display, Target(image)).psnr_db)
"""

from recon.holography.display import (
    DcTerm,
    Display,
    Etendue,
    ScatteringMask,
    eyebox_for_field_of_view,
    field_of_view_for_eyebox,
    pixels_for,
    pixels_per_degree,
    random_mask,
)
from recon.holography.judge import Scores, judge
from recon.holography.limit import Limit, hologram_limit
from recon.holography.losses import LOSSES, Loss
from recon.holography.model import Evaluation, HologramModel
from recon.holography.optimise import (
    Hologram,
    HologramRecord,
    HologramStop,
    compute_hologram,
    one_step,
)
from recon.holography.options import HologramOptions
from recon.holography.spot_list import SpotList, SpotScores, compute_spots, spot_array
from recon.holography.target import Grid, Target, foveal_weights, painted_weights

__all__ = [
    "LOSSES",
    "DcTerm",
    "Display",
    "Etendue",
    "Evaluation",
    "Grid",
    "Hologram",
    "HologramModel",
    "HologramOptions",
    "HologramRecord",
    "HologramStop",
    "Limit",
    "Loss",
    "ScatteringMask",
    "Scores",
    "SpotList",
    "SpotScores",
    "Target",
    "compute_hologram",
    "compute_spots",
    "eyebox_for_field_of_view",
    "field_of_view_for_eyebox",
    "foveal_weights",
    "hologram_limit",
    "judge",
    "one_step",
    "painted_weights",
    "pixels_for",
    "pixels_per_degree",
    "random_mask",
    "spot_array",
]
