"""How large a field, and how fine pixels."""

from __future__ import annotations

import numpy as np

from recon.camera.camera_model import Depths, ModelName
from recon.reconstruction.choice import Decision, Option
from recon.reconstruction.estimates import ERROR_SCALE, left_out_db, loss_db
from recon.reconstruction.overrides import Overrides
from recon.reconstruction.probe import ACCEPTED, acceptance_px, psf_window, resolution_px

LEAST_SIDE = 20
"""Pixels along the longest side that binning leaves at least."""
SAMPLES = 7.0
"""Pixels over the full width of a PSF's autocorrelation at half its height. With 5 a soft picture lost 0.6
dB: priors bring back more than the PSF's width says."""


def binning_of(depths: Depths, overrides: Overrides, *, whole: bool) -> Decision:
    """Decide how many pixels are averaged; ``whole``: none is erased."""
    sharpest = min(resolution_px(p) for psfs in depths.central for p in psfs)
    side = max(depths.central.shape[2:])
    if not np.isfinite(sharpest):
        sharpest = float(side)
    fitting = min(max(1, int(sharpest / SAMPLES)), max(1, side // LEAST_SIDE))
    asked = overrides.binning is not None
    binning = overrides.binning or (fitting if whole else 1)
    why = (
        f"the sharpest PSF's autocorrelation is {sharpest:.1f} pixels wide at half its height, and "
        f"{SAMPLES:g} (binned) pixels over that width are enough"
    )
    if sharpest < SAMPLES:
        why = (
            f"the sharpest PSF's autocorrelation is {sharpest:.1f} pixels wide at half its height, less than "
            f"the {SAMPLES:g} that would be enough: there is nothing to bin"
        )
    if not whole and not asked and fitting > 1:
        why = f"erased pixels are not averaged with others; else {why}"
    up = None if binning == 1 else Option(str(binning - 1), (binning / (binning - 1)) ** 2, 0.0)
    down = None
    if side // (binning + 1) >= 16:
        down = Option(
            str(binning + 1),
            (binning / (binning + 1)) ** 2,
            loss_db(max(SAMPLES * (binning + 1) / sharpest - 1, 0.0) * ERROR_SCALE),
        )
    numbers = {"binning": float(binning), "autocorrelation_px": sharpest}
    return Decision("binning", f"{binning} x {binning}", why, 0.0, up, down, asked, numbers)


def field_of(
    depths: Depths, overrides: Overrides, model: ModelName, *, haze: bool
) -> tuple[tuple[int, int], float | None, Decision]:
    """Decide how far from the axis the object is modelled.

    Parameters
    ----------
    depths : Depths
    overrides : Overrides
    model : str
        One convolution takes the whole field at no more cost than a part of it.
    haze : bool
        Whether there may be smooth light that no background takes: the object beyond what the sensor accepts
        then does, and shutting it out would bring it into the picture (1.4 dB in one scene of a microscope).

    Returns
    -------
    (int, int)
        Central part of the PSFs that holds their light.
    float or None
        Distance from the axis, pixels, beyond which the sensor accepts nothing; None: no limit in the field.
    Decision
    """
    height, width = depths.central.shape[2:]
    asked = overrides.field == "all"
    window = (height, width) if asked else psf_window(depths)
    reach = None if asked else acceptance_px(depths)
    full = (2 * height - 1) * (2 * width - 1)
    extent = (height + window[0] - 1, width + window[1] - 1)
    why = f"the PSFs' light lies within {window[0]} x {window[1]} of {height} x {width} pixels"
    if reach is not None and reach < 0.5 * float(np.hypot(*extent)):
        why += f"; {reach:.0f} pixels off the axis PSFs are down to {ACCEPTED:.0%} of the central one's light"
        if model == "convolution":
            why += ", which is no limit to one convolution"
            reach = None
        elif haze:
            why += ", but smooth light that nothing else takes may go beyond"
            reach = None
    else:
        reach = None
    modelled = extent[0] * extent[1] if reach is None else min(np.pi * reach**2, extent[0] * extent[1])
    share = modelled / full
    up = None if share > 0.99 else Option(f"{2 * height - 1} x {2 * width - 1}", 1 / share, 0.0)
    down = None
    if height * width < modelled:
        down = Option(f"{height} x {width}", height * width / modelled, _beyond_db(depths, window))
    numbers = {"share_of_largest": share}
    value = f"{extent[0]} x {extent[1]} pixels" + ("" if reach is None else f", {reach:.0f} about the axis")
    return window, reach, Decision("field", value, why, 0.0, up, down, asked, numbers)


def _beyond_db(depths: Depths, window: tuple[int, int]) -> float:
    """Return what is lost where only the object opposite to the sensor is modelled.

    An even object beyond it throws as much light onto the sensor as the part of the PSFs that the sensor's
    own object throws beside it: light in the wrong place.
    """
    height, width = depths.central.shape[2:]
    lost = (window[0] / (2 * height) + window[1] / (2 * width)) / 2
    return left_out_db(float(lost))
