"""Noise of the images that tests of points are made with: asked for, or that of a calibration's frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.arrays import Array, Float64Array
from recon.base.declare import option

USUAL_ELECTRONS, USUAL_READ_E = 10_000.0, 2.0
"""Of a photograph whose noise nobody knows."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the test images."""

    electrons: float = USUAL_ELECTRONS
    """At the brightest pixel."""
    read_e: float = USUAL_READ_E
    """Read noise, electrons."""

    def expose(self, light: Array, rng: np.random.Generator) -> Float64Array:
        """Return one exposure of an image, in the image's units."""
        scale = self.electrons / float(light.max())
        charge = rng.poisson(np.maximum(light, 0) * scale) + rng.normal(0.0, self.read_e, light.shape)
        return np.asarray(charge / scale)


@dataclass(frozen=True, slots=True)
class AskedNoise:
    """Noise of the test images: what is not given is that of the calibration's frames, where they tell it."""

    electrons: float | None = option(
        None,
        help="Electrons at the brightest pixel of the tests' images.",
        default_words="as the frames tell, else 10000",
        least=1,
        group="Point tests",
    )
    read_e: float | None = option(
        None,
        help="Read noise of the tests' images, electrons.",
        default_words="as the frames tell, else 2",
        least=0,
        flags=("--read-noise",),
        metavar="E",
        label="Read noise (electrons)",
        group="Point tests",
    )

    def of(self, quality: Mapping[str, Any]) -> tuple[Noise, str]:
        """Return the noise for a calibration of this quality, and where it comes from in words."""
        kept = quality.get("noise")
        measured: Mapping[str, Any] = kept if isinstance(kept, Mapping) else {}

        def known(name: str, given: float | None, usual: float) -> tuple[float, str]:
            if given is not None:
                return given, "given"
            seen = measured.get(name)
            if isinstance(seen, int | float) and np.isfinite(seen) and seen >= 0:
                return float(seen), "measured in its frames"
            return usual, "assumed"

        electrons, source = known("electrons", self.electrons, USUAL_ELECTRONS)
        read_e, read_source = known("read_e", self.read_e, USUAL_READ_E)
        words = source if source == read_source else f"{source}; the read noise {read_source}"
        return Noise(max(electrons, 1.0), read_e), words
