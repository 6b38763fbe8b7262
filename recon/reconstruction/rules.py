"""What each choice goes by: camera model, field and pixels, background, when to stop, precision."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from recon.arrays import BoolArray
from recon.base.blocks import whole_blocks
from recon.camera.camera_model import (
    CAMERAS,
    LOW_RANK_ERROR,
    TOLERATED,
    Depths,
    Extent,
    ModelName,
    choose_model,
)
from recon.camera.varying_psfs import principal_psfs
from recon.reconstruction.choice import Decision
from recon.reconstruction.options import Overrides
from recon.reconstruction.probe import ACCEPTED, MARGIN, Within, acceptance_px, psf_window, resolution_px
from recon.verdict.cases import shipped_maps
from recon.verdict.map import PRECISION

HIDDEN, HIDDEN_VARIATION = 4.0, 0.4
"""Volumes by total variation: the PSFs' relative differences times the data's contrast in units of its
noise, and the differences themselves, up to which one convolution serves. Below, in 16 dim volumes, the true
camera was 0.1 dB worse in the mean (between 1.4 better and 1.6 worse), for four times the time; where PSFs
differed by 0.7 it was up to 1.3 dB better however dim, as it was with l1 and in pictures at any light."""


def candidates(depths: Depths) -> tuple[ModelName, ...]:
    """Return the camera models that a calibration allows, the smallest first."""
    return ("convolution", "lowrank", "local") if depths.varies else ("convolution",)


def model_of(
    depths: Depths, overrides: Overrides, contrast: float | None, costs: Mapping[ModelName, int]
) -> tuple[ModelName, Decision]:
    """Decide on the camera model, with its neighbours on the scale convolution, low-rank, local.

    Parameters
    ----------
    depths : Depths
    overrides : Overrides
    contrast : float or None
        Standard deviation of the data in units of its noise, of a volume with total variation; None: of
        anything else.
    costs : mapping
        Of every candidate.
    """
    asked = overrides.model is not None
    model, why = choose_model(depths, overrides.model or "auto")
    variation = depths.field_error if depths.varies else 0.0
    scale = candidates(depths)
    numbers = {"psf_variation": variation, "tolerated": TOLERATED}
    if varying := len(scale) > 1 and model in scale:
        low = principal_psfs(max(depths.fields, key=lambda f: len(f.points)), error=LOW_RANK_ERROR)
        rank = len(low.components)
    if asked:
        why = "as asked"
    elif model != "convolution":
        differ = f"PSFs differ by {variation:.1%} over the field"
        share = costs["lowrank"] / max(costs["local"], 1)
        components = f"{differ}; {rank} component{'s' if rank > 1 else ''} tell all but {LOW_RANK_ERROR:.0%}"
        if contrast is not None and contrast * variation <= HIDDEN and variation <= HIDDEN_VARIATION:
            model = "convolution"
            why = (
                f"{differ}; in data whose contrast is {contrast:.1f} times the noise that is "
                f"{contrast * variation:.1f} times the noise, and up to {HIDDEN:g} is hidden in that of a "
                "volume"
            )
        elif share < 1:
            model, why = "lowrank", f"{components}, at {share:.2f} of the local model's transforms"
        else:
            model, why = "local", f"{components}, at {share:.2f} times the local model's transforms"
    unjudged = [name for name, offered in CAMERAS.items() if offered.refuses(depths) is None]
    if unjudged and not asked:
        why += (
            f"; left out: {', '.join(unjudged)}, of which nobody knows what it costs and gains "
            f"(--model {unjudged[0]} takes it)"
        )
    if not varying:
        return model, Decision("model", model, why, numbers=numbers, overruled=asked, open=False)
    numbers |= {"rank": float(rank), "rank_error": low.error}

    def step(by: int) -> str | None:
        place = scale.index(model) + by
        return scale[place] if 0 <= place < len(scale) else None

    return model, Decision("model", model, why, step(1), step(-1), asked, numbers)


LEAST_SIDE = 20
"""Pixels along the longest side that binning leaves at least."""
SAMPLES = 7.0
"""Pixels over the full width of a PSF's autocorrelation at half its height. With 5 a soft picture lost 0.6
dB: priors bring back more than the PSF's width says."""


def binning_of(depths: Depths, overrides: Overrides, valid: BoolArray) -> Decision:
    """Decide how many pixels are averaged; ``valid``, (n_channels, height, width): which are not erased."""
    sharpest = min(resolution_px(p) for psfs in depths.central for p in psfs)
    side = max(depths.central.shape[2:])
    if not np.isfinite(sharpest):
        sharpest = float(side)
    fitting = min(max(1, int(sharpest / SAMPLES)), max(1, side // LEAST_SIDE))
    asked = overrides.binning is not None
    kept = whole_blocks(valid, fitting)
    binning = overrides.binning or kept
    why = (
        f"the sharpest PSF's autocorrelation is {sharpest:.1f} pixels wide at half its height, and "
        f"{SAMPLES:g} (binned) pixels over that width are enough"
    )
    if sharpest < SAMPLES:
        why = (
            f"the sharpest PSF's autocorrelation is {sharpest:.1f} pixels wide at half its height, less than "
            f"the {SAMPLES:g} that would be enough: there is nothing to bin"
        )
    if kept < fitting and not asked:
        why = f"erased pixels are not averaged with others; else {why}"
    up = None if binning == 1 else str(binning - 1)
    down = str(binning + 1) if side // (binning + 1) >= 16 else None
    numbers = {"binning": float(binning), "autocorrelation_px": sharpest}
    value = f"{binning} x {binning}"
    return Decision("binning", value, why, up, down, asked, numbers, open=binning > 1)


def field_of(
    depths: Depths, overrides: Overrides, model: ModelName, within: Within | None, *, haze: bool, plain: bool
) -> tuple[Extent, Decision]:
    """Decide how far from the axis the object is modelled.

    Parameters
    ----------
    depths : Depths
    overrides : Overrides
    model : str
        One convolution takes the whole field at no more cost than a part of it.
    within : Within or None
        Where PSFs vary: whether the data ask for light from where none was measured.
    haze : bool
        Whether there may be smooth light that no background takes: the object beyond what the sensor accepts
        then does, and shutting it out would bring it into the picture (1.4 dB in one scene of a microscope).
    plain : bool
        Whether it is a picture through one PSF without a background, whose solver takes the whole field.

    Returns
    -------
    Extent
    Decision
    """
    height, width = depths.central.shape[2:]
    largest, overruled = f"{2 * height - 1} x {2 * width - 1}", overrides.field is not None
    if plain:
        why = "one convolution of a picture is quick on everything that can reach the sensor"
        numbers = {"share_of_largest": 1.0}
        whole = Decision("field", f"{largest} pixels", why, overruled=overruled, numbers=numbers, open=False)
        return Extent((height, width)), whole
    asked = overrides.field == "all"
    shut = within is not None and within.asks
    window = (height, width) if asked or shut else psf_window(depths)
    reach = None if asked or shut else acceptance_px(depths)
    extent = (height + window[0] - 1, width + window[1] - 1)
    why = (
        "the PSFs are whole: with what is faint in them cut off a film's cells were followed worse"
        if shut
        else f"the PSFs' light lies within {window[0]} x {window[1]} of {height} x {width} pixels"
    )
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
    if within is not None:
        why += (
            f"; held-out pixels are missed by {within.anywhere:.2f} times the error to expect, with light "
            f"only where PSFs were measured ({MARGIN:.0%} beyond) by {within.spanned:.2f} times"
        )
    share = modelled / ((2 * height - 1) * (2 * width - 1))
    up = None if share > 0.99 else largest
    down = f"{height} x {width}" if height * width < modelled else None
    numbers = {"share_of_largest": share}
    value = f"{extent[0]} x {extent[1]} pixels" + ("" if reach is None else f", {reach:.0f} about the axis")
    if shut:
        value += ", where PSFs were measured"
    return Extent(window, reach, MARGIN if shut else None), Decision(
        "field", value, why, up, down, asked, numbers
    )


STRAY_SHARE = 0.2
"""Share of the data's light, in a coarse l1 pass's smooth background, from which on there may be stray light
in a picture: sparse ones without any had up to 0.15 there, dense ones, which l1 does not explain, 0.75."""
SETTLED = {
    "convolution": 1e-3,
    "merged": 1e-3,
    "varying picture": 2e-3,
    "varying volume": 4.5e-3,
    "varying points": 8e-3,
}
"""Change an iteration at which pictures were seen to be within 0.2 dB of the end: the solver of varying PSFs,
with its exact data term, goes further in one iteration, and points in a volume (l1) are found early. Merged
colours have the light of all: less noise, and more to be gained at the end, in a third of the time."""
USUAL_ITERATIONS = {"convolution": 100, "varying": 60}


def is_stray(share: float) -> bool:
    """Tell whether the smooth part of a coarse l1 pass may be stray light."""
    return share >= STRAY_SHARE


def iterations_of(tolerance: float, overrides: Overrides, *, plain: bool) -> Decision:
    """Say why to stop at a change an iteration; ``plain`` as in :func:`field_of`."""
    asked = overrides.tolerance is not None
    seen = "pictures were seen to be within 0.2 dB of the end there"
    usual = "where this solver stops by default" if plain else seen
    return Decision(
        "iterations",
        f"until they change by less than {tolerance:g}",
        "as asked" if asked else usual,
        up=f"until {tolerance / 10:g}",
        down=f"until {tolerance * 3:g}",
        overruled=asked,
        numbers={"tolerance": tolerance},
        open=False,
    )


METHOD = "admm tv"
"""Of the map; it is ADMM that reconstructs what is chosen here. The map is of pictures; those of volumes are
ADMM as well, with sums as long for each of their planes."""


def drift(iterations: int, pixels: int) -> float:
    """Return how far float32 is expected to differ from float64, relative to the solution.

    From the shipped map over iterations and size of the picture, by powers of both that its points give;
    never falling with either beyond what was measured.
    """
    found = shipped_maps()["precision"]
    x, y = (np.asarray(found[axis]["values"], float) for axis in ("x", "y"))
    error = np.asarray(found["methods"][METHOD]["error"], float)
    rows, columns = np.meshgrid(np.log(y / y.mean()), np.log(x / x.mean()), indexing="ij")
    table = np.stack([np.ones(error.size), rows.ravel(), columns.ravel()], axis=1)
    _, by_size, by_count = np.linalg.lstsq(table, np.log(np.maximum(error, 1e-12)).ravel(), rcond=None)[0]
    grown = max(by_size, 0.0) * np.log(max(pixels / y.max(), 1.0)) + max(by_count, 0.0) * np.log(
        max(iterations / x.max(), 1.0)
    )
    return float(error.max() * np.exp(grown))


def precision_of(overrides: Overrides, iterations: int, pixels: int) -> Decision:
    """Decide in which precision to compute.

    Parameters
    ----------
    overrides : Overrides
    iterations, pixels : int
        How many are usual, and the longest side.
    """
    expected = drift(iterations, pixels)
    asked = overrides.precision is not None
    why = (
        f"by the stability map float32 differs from float64 by at most {expected:.0e} of the picture after "
        f"{iterations} iterations on {pixels} pixels ({PRECISION:.0%} is a failure)"
    )
    numbers = {"expected_difference": expected}
    value = overrides.precision or ("float64" if expected > PRECISION else "float32")
    double = value == "float64"
    up, down = (None, "float32") if double else ("float64", None)
    return Decision("precision", value, why, up, down, asked, numbers, open=double)
