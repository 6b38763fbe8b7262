"""Whether colour channels are one picture in several tints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.errors import InputError
from recon.reconstruction.choice import Decision, Option
from recon.reconstruction.estimates import ERROR_SCALE
from recon.reconstruction.overrides import Wishes
from recon.reconstruction.probe import CHANNEL_NOISE, CHANNEL_PSF, colours
from recon.reconstruction.reduced import Colours
from recon.types import Calibration

Array = npt.NDArray[Any]

LEAST_COMMON, LEAST_COMMON_SHARE = 64, 0.05
"""Pixels, and share of all, that must tell all colours for channels to be compared and merged."""


def merged(
    data: Array, valid: Array, calibration: Calibration, tint: Colours
) -> tuple[Array, Array, Calibration]:
    """Return data, valid pixels and calibration of one channel in the place of several."""
    psfs = calibration.psfs
    if psfs.shape[1] > 1:
        psfs = tint.merged(psfs, tint.psf)[:, None]
    return (
        tint.merged(data, tint.scene)[None],
        np.asarray(valid.all(axis=0))[None],
        replace(calibration, psfs=psfs),
    )


def merged_input(
    data: Array, valid: Array, noise: Array, calibration: Calibration
) -> tuple[Array, Array, Calibration, Colours]:
    """Return data, valid pixels and calibration of one channel in the place of several, and their colours.

    Raises
    ------
    InputError
        Where there is one channel.
    """
    tint = colours(data, noise, valid, calibration.psfs)
    if tint is None:
        raise InputError("There is one channel: nothing can be merged.")
    return (*merged(data, valid, calibration, tint), tint)


def channels_of(
    data: Array, deviation: Array, valid: Array, psfs: Array, wishes: Wishes
) -> tuple[Decision, Colours | None]:
    """Decide whether colour channels are reconstructed as one; also return how they are proportional."""
    n = len(data)
    if n == 1:
        return Decision("channels", "one", "the photograph has one channel"), None
    common = int(np.count_nonzero(valid.all(axis=0)))
    if common < max(LEAST_COMMON, LEAST_COMMON_SHARE * valid[0].size):
        why = f"only {common} of {valid[0].size} pixels tell all colours, as with a colour mosaic"
        if wishes.channels == "merged":
            raise InputError(f"Channels cannot be merged: {why}. Leave channels=merged out.")
        return Decision("channels", f"all {n}", why, overruled=wishes.channels is not None), None
    tint = colours(data, deviation, valid, psfs)
    assert tint is not None
    numbers = {"misfit": tint.misfit, "psf_misfit": tint.psf_misfit}
    alike = tint.misfit <= CHANNEL_NOISE and tint.psf_misfit <= CHANNEL_PSF
    asked = wishes.channels is not None
    merge = wishes.channels == "merged" if asked else alike
    why = (
        f"channels proportional to one another miss the data by {tint.misfit:.2f} of its noise and the PSFs "
        f"by {tint.psf_misfit:.1%} (up to {CHANNEL_NOISE:g} and {CHANNEL_PSF:.0%} pass for alike)"
    )
    loss = -10 * float(np.log10(1 + max(tint.misfit**2 - 1, 0) + (tint.psf_misfit / ERROR_SCALE) ** 2))
    if merge:
        up = Option(f"all {n}", float(n), -loss)
        return Decision("channels", "merged", why, loss, up=up, overruled=asked, numbers=numbers), tint
    down = Option("merged", 1 / n, loss)
    return Decision("channels", f"all {n}", why, 0.0, down=down, overruled=asked, numbers=numbers), tint
