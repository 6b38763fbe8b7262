"""Scenes whose reconstructions ``growth.py --explained`` foretells and carries out, with their options."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon import Calibration
from recon.base.blocks import block_mean
from recon.evaluation.measured_sets import MEASURED, measured_set
from recon.evaluation.scene import make_scene

KINDS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "picture": ("dense-picture", {"size": 128}, {}),
    "picture, l1": ("dense-picture", {"size": 128}, {"prior": "l1"}),
    "sparse": ("sparse-picture", {"size": 128}, {}),
    "sparse, l1": ("sparse-picture", {"size": 128}, {"prior": "l1"}),
    "colour": ("dense-picture", {"size": 128, "channels": 3, "colourful": True}, {}),
    "text": ("text", {"size": 192}, {}),
    "9 PSFs, local": ("dense-picture", {"size": 96, "grid": 3, "aberration": 0.5}, {"model": "local"}),
    "9 PSFs, lowrank": ("dense-picture", {"size": 96, "grid": 3, "aberration": 0.5}, {"model": "lowrank"}),
    "9 PSFs, auto": ("sparse-picture", {"size": 96, "grid": 3, "aberration": 0.5}, {}),
    "beads": ("beads", {"size": 96}, {}),
    "beads, l1": ("beads", {"size": 96}, {"prior": "l1"}),
    "volume": ("dense-volume", {"size": 96}, {}),
    "volume, 9 PSFs": ("microscope", {"size": 64, "grid": 3}, {}),
    "hand": ("hand", {"binning": 4}, {}),
    "hand, l1": ("hand", {"binning": 4}, {"prior": "l1"}),
    "hand, small": ("hand", {"binning": 8}, {}),
    "USAF, 9 planes": ("usaf", {"binning": 2, "every": 5}, {}),
    "USAF, 32 planes": ("usaf", {"binning": 2, "first": 32}, {}),
    "USAF, 44, l1": ("usaf", {"binning": 2}, {"prior": "l1"}),
    "hand, large": ("hand", {"binning": 2}, {}),
    "USAF, large": ("usaf", {"binning": 1, "every": 4}, {}),
    "texture": ("texture", {"size": 160}, {}),
    "filaments": ("filaments", {"size": 160}, {}),
    "lights": ("lights", {"size": 160}, {}),
    "gradient, l1": ("gradient", {"size": 160}, {"prior": "l1"}),
    "9 PSFs, large": ("filaments", {"size": 192, "grid": 3, "aberration": 0.5}, {"model": "local"}),
    "colour, 9 PSFs": (
        "dense-picture",
        {"size": 128, "channels": 3, "colourful": True, "grid": 3, "aberration": 0.5},
        {"model": "local"},
    ),
    "volume, lowrank": ("microscope", {"size": 64, "grid": 3}, {"model": "lowrank"}),
    "volume, colour": ("dense-volume", {"size": 64, "channels": 3}, {}),
    "volume, large": ("dense-volume", {"size": 192}, {}),
    "beads, large": ("beads", {"size": 192}, {}),
}
"""Scenes by family, sizes and options, whose reconstructions are explained; some are measured sets."""


def made_of(family: str, seed: int, **sizes: Any) -> tuple[np.ndarray, Calibration]:
    """Return photograph and calibration of a scene, or of a measured set: binned, and some of its depths."""
    if family not in MEASURED:
        scene = make_scene(family, seed=seed, **sizes)  # type: ignore[arg-type]
        return scene.measurement, scene.calibration
    psfs, photograph = (block_mean(a, sizes["binning"]) for a in measured_set(family))
    psfs = psfs[: sizes.get("first")][:: sizes.get("every", 1)]
    positions = np.zeros((len(psfs), 3))
    positions[:, 2] = np.arange(1.0, len(psfs) + 1)
    return photograph, Calibration(psfs[:, None], positions)
