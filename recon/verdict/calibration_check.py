"""Whether a calibration belongs to a photograph: whether it explains it better than its own decoys.

A right PSF explains a photograph far better than its own mirror image, and lies at the minimum over small
turns and sizes. So the given calibration competes with such decoys on the photograph at hand, by few
iterations on few pixels each (:mod:`recon.reconstruction.decoys`): no simulated case is asked. The score is
the posterior's logarithm, half the squared residual in units of the noise and the prior; its differences are
natural logarithms of odds ("nats"). Where a background or noise leaves every PSF able to explain the data,
the prior still tells, and where it does not either, that is said.

Odds alone count noise as the only error. Cameras have others (light from beyond the field, depths between
those calibrated, a pattern that varies), of which a bright photograph makes thousands of nats. So the tiles
of a photograph vote as well: one PSF is better than another where it leaves less fine structure tile by tile,
by more standard errors than tiles differ.

What cannot be told: a PSF that is only displaced casts the same picture, displaced; one that is somewhat
larger is that of a nearer scene; and so is, in a volume, a depth for another between those calibrated.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from recon.camera.transformed import Transformation

GIVEN = Transformation()
BETWEEN = Transformation(0.37, 0.37)
"""The calibration itself displaced by part of a pixel, which displaces the picture alone: interpolated as its
decoys are. The better of the two counts as the given one."""
FAR = (
    Transformation(mirrored=True),
    Transformation(rotation_deg=180.0),
    Transformation(mirrored=True, rotation_deg=180.0),
)
"""Decoys that have as much light at as many places, and nothing to do with the photograph."""
EDGE_PX = 0.6
"""By how much near decoys move a pattern's edge at least, pixels: less tells nothing."""
TOLD_SHARE = 0.002
"""Odds relative to the score, from which they are no errors of the model."""


class Certainty(NamedTuple):
    """What it takes for one PSF to be better than another."""

    nats: float
    """Odds."""
    errors: float
    """Standard errors by which tiles must say so as well."""


CERTAIN = Certainty(25.0, 2.5)
"""That a calibration is the photograph's own, of its far decoys: chance alone makes so much of sixteen tiles
once in eighty times (Student's t), of the larger of two tests (:meth:`Score.leads`) at most once in forty."""
NEARLY = Certainty(12.0, 1.75)
"""That it is off, or not, of its near decoys (at most once in ten times): a right one is ahead of them by 0.8
standard errors and more, and none of theirs had odds of more than one nat."""
SPEAKS_NATS = 200.0
"""Odds among all that were tried from which a photograph has its say on foreign ones."""
NOT_OWN = 1.0
"""Standard errors by which tiles prefer the calibration to each of its far decoys, up to which it is not the
photograph's own: set for one test, the larger of two lets some foreign ones pass (up to 1.4 were seen)."""
STRUCTURE_NATS, OWN_SHARE = 1000.0, 0.025
"""Fine structure of a photograph that any of the PSFs explains, half its squares (noise that is thought to be
less than it is is explained by none), from which one that resolves it has to be ahead of its far decoys by
that share of all: of 25 right ones the least was 4 %, of 32 foreign ones the most 2.7 %."""
OTHERS, EQUAL = 0.04, 0.005
"""Shares of that structure: from the first, by which two of three far decoys explain less, a calibration is
not foreign though the third explains as much, or more by the second. Right ones through the USAF set's PSFs,
which are half their own mirror images, have 4.2 to 6.7 %, a foreign one 3.4 %."""
HARDLY = 0.75
"""Residual of the better one over the calibration's, from which it may be better by chance: the measured hand
turned by 1 and 2 degrees or 2 % smaller 0.64, 0.28 and 0.40; a PSF of the USAF set on the hand, and its own
cropped, 0.83 and 0.93."""
LIKELIER = 0.05
"""Score of all far decoys beyond the calibration's, relative to it, from which it is not called foreign
either: in small photographs of a few beads tiles tell little."""
EXPLAINED = 1.1
"""Mean squared fine structure that is left, in units of the noise, from which a calibration that is no better
than its far decoys is another camera's; below, any pattern explains the photograph."""
LEAST = 1e-12
"""Mean square below which tiles do not differ."""


class Fit(enum.StrEnum):
    """What a photograph says of a calibration."""

    FITS = "fits"
    OFF = "off"
    FOREIGN = "foreign"
    UNTOLD = "untold"


class Score(NamedTuple):
    """How well a PSF explains a photograph."""

    misfit: float
    """Mean square of the residual in units of the noise."""
    objective: float
    """Mean square of its fine structure and twice the prior, a pixel: slow waves are left by stray light and
    unfinished iterations, which another PSF may explain better."""
    fine: tuple[float, ...]
    """Mean square of the residual less its own local mean, tile by tile of the photograph."""
    tiles: tuple[float, ...]
    """The objective tile by tile, the prior where the picture has what it asks for: of faint photographs it
    is the prior that tells."""

    def leads(self, other: Score) -> float:
        """By how many standard errors its fine structure or objective is less, as tiles differ.

        Whichever says more: of few bright things the prior is in few tiles, of faint ones the rest is noise.
        """
        return max(_ahead(self.fine, other.fine), _ahead(self.tiles, other.tiles))


def _ahead(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    ratio = np.log(np.maximum(other, LEAST) / np.maximum(one, LEAST))
    scatter = float(np.std(ratio, ddof=1)) / len(ratio) ** 0.5 if len(ratio) > 1 else np.inf
    return float(np.mean(ratio)) / max(scatter, LEAST)


@dataclass(frozen=True, slots=True)
class CalibrationCheck:
    """What became of a calibration among its decoys.

    Attributes
    ----------
    fit : Fit
    scores : mapping
        By transformation; :data:`GIVEN` is that of the calibration itself.
    pixels : int
        That they were taken on.
    better : Transformation or None
        The decoy that explains the photograph better, where one does.
    cause : (str, str) or None
        What is known to keep it from fitting, in words, and what to do.
    """

    fit: Fit
    scores: Mapping[Transformation, Score]
    pixels: int
    better: Transformation | None = None
    cause: tuple[str, str] | None = None

    @property
    def sure(self) -> bool:
        """Whether it fits and is certainly ahead of all its near decoys, too."""
        given = self.scores[GIVEN]
        near = [score for how, score in self.scores.items() if how not in (GIVEN, BETWEEN, *FAR)]
        return self.fit is Fit.FITS and is_ahead(given, near, self.pixels, NEARLY)

    @property
    def wrong(self) -> bool:
        """Whether it is not the photograph's own calibration."""
        return self.fit in (Fit.OFF, Fit.FOREIGN)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is wrong with it, and what to do; empty where it fits."""
        if self.wrong and self.cause is not None:
            found, help_ = self.cause
            return (f"the calibration does not fit this photograph: {found}", help_)
        if self.fit is Fit.OFF and self.better is not None:
            left = (self.scores[self.better].misfit / self.scores[GIVEN].misfit) ** 0.5
            why = (
                "one of the two was flipped or turned: give both as the camera saw them"
                if self.better in FAR
                else "diffuser or sensor moved since it was made, or the scene lies at another depth: "
                "--refine-psf fits the PSF to it; else calibrate again, or choose the scene's depth"
            )
            if left > HARDLY and self.better not in FAR:
                why += ". What is still unexplained is much: it may be another diffuser's, binning or crop"
            return (
                "the calibration does not fit this photograph: its PSF explains it better "
                f"{self.better} (the residual falls to {left:.0%})",
                f"Probably {why}",
            )
        if self.fit is Fit.FOREIGN:
            return (
                "the calibration does not belong to this photograph: its PSF explains it no better than it "
                "would mirrored or upside down",
                "Give the calibration of this camera and diffuser, at this binning and crop and at the "
                "scene's depth",
            )
        if self.fit is Fit.UNTOLD:
            return (
                "the photograph does not tell whether the calibration is its own: any PSF would explain it "
                "as well",
            )
        return ()

    def as_json(self) -> dict[str, Any]:
        """Return it for a file."""
        return {
            "fit": str(self.fit),
            "better": None if self.better is None else str(self.better),
            "scores": {str(t): [s.misfit, s.objective] for t, s in self.scores.items()},
            "pixels": self.pixels,
            "cause": None if self.cause is None else list(self.cause),
        }


def near_decoys(shape: tuple[int, int], *, sizes: bool) -> tuple[Transformation, ...]:
    """Return the decoys that a right calibration on so many pixels beats narrowly.

    Turned by a degree and, with ``sizes``, enlarged by one per cent, by more on few pixels: in a volume
    another size is another depth.
    """
    step = max(0.01, EDGE_PX / (max(shape) / 2))
    degrees = max(1.0, float(np.rad2deg(step)))
    turned = (Transformation(rotation_deg=degrees), Transformation(rotation_deg=-degrees))
    return (*turned, Transformation(scale=1 + step), Transformation(scale=1 - step)) if sizes else turned


def check_of(scores: Mapping[Transformation, Score], pixels: int, structure: float = 0.0) -> CalibrationCheck:
    """Judge a calibration by its score and its decoys'.

    Parameters
    ----------
    scores : mapping
        Of :data:`GIVEN`, :data:`BETWEEN` where it was tried, near ones and farther, and of the :data:`FAR`
        ones that do not resemble it: where all do, as of regular lenslets, only the near ones tell.
    pixels : int
        Valid ones.
    structure : float
        Mean square of the photograph's own fine structure beyond the noise; 0 where the PSF resolves none.
    """
    given = as_given(scores)
    scores = {**scores, GIVEN: given}
    decoys = {how: score for how, score in scores.items() if how not in (GIVEN, BETWEEN)}
    better = min(decoys, key=lambda how: decoys[how].objective)
    far = {how: decoys[how] for how in FAR if how in decoys}
    others = [score for how, score in far.items() if how != better]
    if is_ahead(decoys[better], (given, *others), pixels, NEARLY):
        return CalibrationCheck(Fit.OFF, scores, pixels, better)
    if is_ahead(given, (far or decoys).values(), pixels):
        return CalibrationCheck(Fit.FITS, scores, pixels)
    objectives = [score.objective for score in (given, *decoys.values())]
    speaks = (max(objectives) - min(objectives)) * pixels / 2 > SPEAKS_NATS
    unlike = float(np.mean(given.fine)) > EXPLAINED and _lead(given, far.values()) < NOT_OWN
    likelier = all(score.objective > (1 + LIKELIER) * given.objective for score in far.values())
    gains = sorted(score.objective - given.objective for score in far.values())
    explained = structure + 1 - min(float(np.mean(score.fine)) for score in scores.values())
    missing = explained * pixels / 2 > STRUCTURE_NATS and min(gains, default=np.inf) < OWN_SHARE * structure
    # A pattern may be half its own mirror image: that decoy explains as much, and the others tell.
    own = structure > 0 and len(gains) > 2 and gains[1] > OTHERS * structure and gains[0] > -EQUAL * structure
    foreign = ((speaks and unlike) or missing) and not likelier and not own
    return CalibrationCheck(Fit.FOREIGN if foreign else Fit.UNTOLD, scores, pixels)


def as_given(scores: Mapping[Transformation, Score]) -> Score:
    """Return the better score of the calibration itself and displaced by part of a pixel."""
    return min((scores[how] for how in (GIVEN, BETWEEN) if how in scores), key=lambda score: score.objective)


def is_ahead(one: Score, others: Iterable[Score], pixels: int, by: Certainty = CERTAIN) -> bool:
    """Whether odds and tiles are certain that a PSF explains a photograph better than all others."""
    others = list(others)
    return all(is_told(one, other, pixels, by) for other in others) and _lead(one, others) > by.errors


def is_told(one: Score, other: Score, pixels: int, by: Certainty = CERTAIN) -> bool:
    """Whether the odds for one and against another are more than chance and errors of the model make."""
    gain = other.objective - one.objective
    return gain * pixels / 2 > by.nats and gain > TOLD_SHARE * other.objective


def _lead(one: Score, others: Iterable[Score]) -> float:
    """Return by how many standard errors it is ahead of all others."""
    return min((one.leads(other) for other in others), default=np.inf)
