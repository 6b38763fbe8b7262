"""A PSF from files: photographs of known pictures, each with what it shows, whoever took them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.optics.beads import MANY_PX
from calibration_routines.optics.screen_solve import DRIFT, SOLVING, ScreenOptions, psf_lines, saved
from calibration_routines.options import Checked
from calibration_routines.procedure import Listener, Outcome
from calibration_routines.psf.analysis import channels_first
from instrument.files.atomic import require_new
from instrument.files.errors import FileError
from instrument.files.images import ImageFile, read_image
from instrument.runs.run_control import RunControl
from recon.arrays import Float32Array
from recon.base.declare import RARE, option
from recon.blind.known_pictures import PictureSettings, psf_from_pictures
from recon.blind.left_out import POOR_DB, LeftOut, leave_out
from recon.types import Calibration, Geometry

PHOTOGRAPHS, PICTURES = ("raw_", "photograph_"), ("truth_", "picture_")
"""What names of files begin with, before what a photograph and its picture have in common."""
_FILES = "With image files"
_SOLVER = PictureSettings()
_JUDGED_ROWS = 128  # of the images that left-out photographs are judged on


@dataclass(frozen=True, kw_only=True)
class PairFiles(Checked):
    """Photographs of known pictures, and how to solve them."""

    pairs: Path | None = option(
        None,
        metavar="FOLDER",
        help="Photographs raw_NAME and what they show, truth_NAME: of equal size, one object pixel a "
        "photograph's pixel, neither flipped.",
        default_words="taken on the bench",
        group=_FILES,
    )
    dark: float = option(0.0, least=0, help="Dark level of the photographs, counts.", group=_FILES)
    gamma: float | None = option(
        None,
        above=0.2,
        most=5,
        help="Exponent that makes a picture's values light.",
        default_words="found",
        group=_FILES,
    )
    beyond: float = option(
        _SOLVER.beyond,
        least=0,
        most=1,
        help="How far beyond the pictures there may be light, of the photographs' height.",
        group=RARE,
    )
    pixel_um: float | None = option(
        None, unit="um", above=0, help="Pixel pitch.", default_words="not known", group=_FILES
    )
    distance_mm: float | None = option(
        None,
        unit="mm",
        above=0,
        label="Diffuser to sensor",
        help="From diffuser to sensor.",
        default_words="not known",
        group=_FILES,
    )


@dataclass(frozen=True, slots=True)
class Pairs:
    """Photographs and what they show.

    Attributes
    ----------
    names : tuple of str
    photographs, pictures : ndarray, float32, (n, n_channels, height, width)
    simulated : bool
        Whether the simulated bench took one.
    """

    names: tuple[str, ...]
    photographs: Float32Array
    pictures: Float32Array
    simulated: bool


def read_pairs(folder: Path, dark: float = 0.0) -> Pairs:
    """Read the pairs of a folder, in the order of their names; pictures are scaled to a peak of 1.

    Raises FileError when there are fewer than two pairs, a photograph has no picture or the other way round,
    two files have one name, or sizes or channels differ.
    """
    photographs, pictures = (_named(folder, beginnings) for beginnings in (PHOTOGRAPHS, PICTURES))
    alone = sorted(set(photographs) ^ set(pictures))
    if alone:
        file = photographs.get(alone[0]) or pictures[alone[0]]
        partner = PICTURES[0] if alone[0] in photographs else PHOTOGRAPHS[0]
        raise FileError(
            file, f"has no partner {partner}{alone[0]} beside it.", "Add it, or take this one away."
        )
    if len(photographs) < 2:
        raise FileError(
            folder,
            f"holds {len(photographs)} pairs of raw_NAME and truth_NAME; two or more are needed.",
            "Name each photograph raw_NAME and what it shows truth_NAME (.npy, .tif, .png).",
        )
    names = tuple(sorted(photographs))
    first = read_image(photographs[names[0]])
    taken, shown = (
        [_of_shape(read_image(files[name]), first) for name in names] for files in (photographs, pictures)
    )
    peak = max(float(image.max()) for image in shown) or 1.0
    return Pairs(
        names,
        np.stack(taken) - np.float32(dark),
        np.stack(shown) / np.float32(peak),
        first.is_simulated,
    )


def _named(folder: Path, beginnings: Sequence[str]) -> dict[str, Path]:
    if not folder.is_dir():
        raise FileError(folder, "is no folder.", "Name the folder that holds the pairs raw_NAME, truth_NAME.")
    found: dict[str, Path] = {}
    for beginning in beginnings:
        for file in sorted(folder.glob(f"{beginning}*")):
            name = file.stem.removeprefix(beginning)
            if file.suffix == ".json":
                continue
            if name in found:
                raise FileError(
                    file, f"has the name {name} of {found[name].name}, too.", "Keep one of the two."
                )
            found[name] = file
    return found


def _of_shape(image: ImageFile, first: ImageFile) -> Float32Array:
    if image.pixels.shape != first.pixels.shape:
        raise FileError(
            image.path,
            f"is {image.describe()}, but {first.path.name} is {first.describe()}.",
            "Photographs and pictures have one size and as many channels; scale the pictures to the "
            "photographs' pixels.",
        )
    return channels_first(np.asarray(image.pixels, np.float32))


def look_at_pairs(files: PairFiles) -> tuple[str, ...]:
    """Return what the folder holds, in words; errors as :func:`read_pairs`."""
    assert files.pairs is not None
    pairs = read_pairs(files.pairs, files.dark)
    _, channels, height, width = pairs.photographs.shape
    words = (
        f"{len(pairs.names)} pairs of {height} x {width} pixels, {channels} "
        f"channel{'s' if channels > 1 else ''}: {', '.join(pairs.names)}"
    )
    if height * width <= MANY_PX:
        return (words,)
    return words, "Note: pairs of more than a megapixel take long to solve; bin the files beforehand."


def solve_pairs(
    asked: ScreenOptions, options: PairFiles, out: Path, control: RunControl, listener: Listener
) -> Outcome:
    """Solve the pairs of a folder for the PSF, judge it by photographs left out, and save the calibration.

    Raises BenchError when the calibration exists; errors as :func:`read_pairs` and ``psf_from_pictures``.
    """
    assert options.pairs is not None
    require_new(out, overwrite=False)

    def solving(_words: str, done: float) -> None:
        control.check()
        listener.share(done, 1.0)

    listener.step("reading the pairs")
    pairs = read_pairs(options.pairs, options.dark)
    settings = PictureSettings(one_psf=not asked.channels, beyond=options.beyond, gamma=options.gamma)
    listener.step(SOLVING)
    solved = psf_from_pictures(
        pairs.photographs,
        pairs.pictures,
        settings,
        on_progress=solving,
    )
    kept = [n for n in range(len(pairs.names)) if n not in solved.foreign]
    names = [pairs.names[n] for n in kept]
    judged: list[LeftOut] = []
    if asked.judged and len(kept) > 2:
        listener.step("judging it by photographs left out")
        numbers = np.linspace(0, len(kept) - 1, min(asked.judged, len(kept))).round().astype(int)
        judged = leave_out(
            pairs.photographs[kept],
            pairs.pictures[kept],
            names,
            replace(settings, foreign=False, gamma=solved.gamma),
            only=[names[number] for number in np.unique(numbers)],
            binning=max(1, pairs.photographs.shape[2] // _JUDGED_ROWS),
            on_progress=solving,
        )
    calibration, path = saved(
        out,
        solved,
        judged,
        asked.z_um,
        Geometry(pixel_pitch_um=options.pixel_um, diffuser_distance_mm=options.distance_mm),
        {
            "pairs": names,
            "foreign": [pairs.names[n] for n in solved.foreign],
            "gamma": solved.gamma,
            "gains": solved.gains.tolist(),
            "brightness": solved.brightness[kept].tolist(),
            "stray": solved.stray[kept].tolist(),
        },
        {"pairs": str(options.pairs.resolve()), "simulated": pairs.simulated},
        _doubts,
    )
    findings = [*_left_out(calibration.quality), *_doubts(calibration.quality)]
    verdict = (*_lines(calibration), *(f"Quality: {finding}" for finding in findings))
    return Outcome(verdict=verdict, good=not findings, calibration=path, result=calibration)


def _lines(calibration: Calibration) -> list[str]:
    quality = calibration.quality
    lines = ["SIMULATED: a photograph comes from the simulated bench"] * calibration.provenance["simulated"]
    lines += [f"The pictures' gamma is {quality['gamma']:.2f}."]
    if quality["wander"] > DRIFT:
        differ = f"Exposures differ by up to {quality['wander']:.0%} from what the pictures say (taken out)."
        lines += [differ]
    return lines + psf_lines(quality)


def _left_out(quality: Mapping[str, Any]) -> list[str]:
    if not quality["foreign"]:
        return []
    return [
        f"left out: {', '.join(quality['foreign'])}, as the others fit far better without. Is that "
        "the picture that was photographed, neither flipped nor shifted?"
    ]


def _doubts(quality: Mapping[str, Any]) -> list[str]:
    if not any(one["psnr_db"] < one["even_db"] + POOR_DB for one in quality["left_out"]):
        return []
    return [
        "photographs left out are hardly reconstructed: do photographs and pictures belong together, are "
        "the pictures neither flipped nor shifted, and is one of their pixels one of the photographs'?"
    ]
