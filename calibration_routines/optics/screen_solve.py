"""From the run of a calibration by a screen to its PSF, and how good that is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.optics.screen_pictures import ScreenMap, ScreenTone
from calibration_routines.options import MM, Checked
from calibration_routines.procedure import Listener, Outcome
from calibration_routines.psf.analysis import binned, channels_first, dark_model, replace_hot
from calibration_routines.purpose import CalibrationError, Purpose
from calibration_routines.scatter import compare, pooled, scatter_of
from instrument.bench.bench import Bench
from instrument.files.atomic import named_by_worth
from instrument.files.calibration_file import save_calibration
from instrument.files.record import RecordFormat
from instrument.files.slm_image import read_slm_levels
from instrument.reconstruction.mosaic import in_colours
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.base.declare import RARE, option
from recon.blind.known_pictures import PicturePsf, PictureSettings, psf_from_pictures, psf_work
from recon.blind.left_out import POOR_DB, LeftOut, judged_by
from recon.types import Calibration, Geometry

TONE, PICTURE, JUDGED, AGAIN = "tone", "picture", "judged", "tone again"
"""What the frames of such a run are called, besides dark ones (the screen shows black)."""
TONES = (24, 48, 80, 112, 144, 176, 208, 232, 255)
"""Grey levels whose light is measured."""
FLICKER, DRIFT = 0.01, 0.02
"""Change of the screen's light, from frame to frame and from picture to picture or over the run, from which
on it is told of."""
PLACE_PX = 0.1
"""Pixels of the camera to which the place of a picture is known, beyond which a shaking picture is told of: a
PSF from pictures that are 0.28 apart is another one by a tenth."""
MOVED_PX, _SURE = 0.7, 3.0
"""Pixels of the camera by which the white picture may lie elsewhere in the end (evenly over the run it blurs
the PSF by a fifth of a pixel), and the standard deviations of its place that this must be."""
_SOLVER = PictureSettings(beyond=0.0, saturated=None, gamma=1.0, foreign=False, rounds=1, psf_iterations=300)
"""Nothing is unknown but the PSF: black is taken off, the tone is measured, and nothing else shines."""
SOLVING = "solving for the PSF"
_JUDGING = 2300.0  # transforms of 1024 x 1024 a megapixel and channel that a picture to judge by takes
_JUDGED_ROWS = 256  # of the images that are reconstructed to judge by
_HOT_SHARE = 1e-3  # of pixels that may be at full scale: hot ones


@dataclass(frozen=True, kw_only=True)
class ScreenOptions(Checked):
    """What to show and how to photograph it."""

    pictures: int = option(16, least=4, help="Random pictures to show.")
    judged: int = option(
        3,
        least=0,
        label="Pictures to judge by",
        help="How these are reconstructed is the PSF's quality: further pictures, of random shapes; with "
        "files, photographs that are left out in turn.",
    )
    average: int = option(4, least=2, label="Frames a picture", help="Frames a picture, averaged.")
    dark_frames: int = option(8, least=1, help="Frames of the black screen, averaged.", group=RARE)
    area: float = option(
        0.8, above=0.1, most=1.0, help="Part of the sensor's field that the pictures fill.", group=RARE
    )
    binning: int = option(1, least=1, help="Software binning, on top of the camera's.")
    z_um: float | None = option(
        None,
        **MM,
        flags=("--z",),
        above=0,
        label="Distance",
        help="Of the screen from the diffuser.",
        default_words="not known",
    )
    channels: bool = option(
        False,
        flags=("--psf-a-channel",),
        label="PSF a channel",
        help="A colour camera's channels get a PSF each; else they share one, of different brightness.",
        group=RARE,
    )
    seed: int = option(0, least=0, help="Of the random pictures.", group=RARE)


@dataclass(frozen=True, slots=True)
class ScreenRecord:
    """What the PSF is solved with besides the frames."""

    asked: ScreenOptions
    map: ScreenMap
    geometry: Geometry
    bench: str
    simulated: bool


SCREEN = Purpose(
    ScreenRecord,
    "screen.json",
    "calibration",
    RecordFormat(
        "diffuserbench screen calibration",
        "run of calibrate screen",
        restore="The frames beside it are not touched.",
    ),
)


@dataclass(frozen=True, slots=True)
class ScreenCalibration:
    """A finished calibration by a screen."""

    calibration: Calibration
    path: Path
    tone: ScreenTone
    findings: tuple[str, ...]
    """What is wrong with the screen's light, in words; empty when it is good."""


def finish_screen(run: Run, _bench: Bench | None, control: RunControl, listener: Listener) -> Outcome:
    """Solve a complete run for the PSF, and save the calibration in its folder.

    Raises CalibrationError when the record is damaged, or the screen's light does not rise with its level.
    """
    record = SCREEN.read(run.path)
    listener.step(SOLVING)

    def solving(_words: str, done: float) -> None:
        control.check()
        listener.share(done, 1.0)

    done = solve_screen(run, record, solving)
    return Outcome(
        verdict=tuple(screen_lines(done)),
        good=not done.findings,
        runs=(run.path,),
        calibration=done.path,
        result=done,
    )


class _Frames:
    """The photographs of a run, by what they are called and show."""

    def __init__(self, run: Run, record: ScreenRecord) -> None:
        self.run, self._record, self._dark = run, record, dark_model(run)
        self.of: dict[str, dict[Path, list[int]]] = {TONE: {}, PICTURE: {}, JUDGED: {}, AGAIN: {}}
        for label, shown in self.of.items():
            for step in run.steps(label):
                assert step.slm_image is not None
                shown.setdefault(step.slm_image, []).append(step.index)

    def mean(self, frames: Sequence[int]) -> Float32Array:
        """Return the mean of some frames, (n_channels, height, width), black taken off, binned."""
        metadata = self.run.metadata(frames[0])
        light = np.mean([self.run.frame(n) for n in frames], axis=0, dtype=np.float32)
        light = replace_hot(light - self._dark.at(metadata.exposure_ms), self._dark.hot)
        light = in_colours(light, metadata.pixel_format)
        return block_mean(channels_first(light), self._record.asked.binning)

    def unsteady(self) -> list[str]:
        """Return what moved, and other light between the frames of a picture, in words."""
        scatters = []
        for frames in self.of[PICTURE].values():
            seen = np.stack([self.mean([n]).mean(axis=0) for n in frames])
            scatters.append(scatter_of(seen)[0])
        by = self._record.asked.binning
        shaken = replace(pooled(scatters).on_pixels(by), flicker=0.0)
        words = shaken.findings("picture", put_back=False)
        if not words and shaken.place_error_px > PLACE_PX:
            words = shaken.causes("frame")
        found = [sentence.rstrip(".") for sentence in words]
        white = list(self.of[TONE].values())[-1]
        (again,) = self.of[AGAIN].values()
        found += moved_meanwhile(self.mean(again).mean(axis=0), self.mean(white).mean(axis=0), binning=by)
        return found

    def level(self, label: str) -> list[float]:
        """Return the light of each photograph of a kind, counts a pixel."""
        return [float(self.mean(frames).mean()) for frames in self.of[label].values()]

    def pairs(self, label: str, tone: ScreenTone) -> tuple[Float32Array, Float32Array]:
        """Return photographs of a kind and the light that they show, (n, n_channels, height, width) both."""
        photographs = np.stack([self.mean(frames) for frames in self.of[label].values()])
        shape, binning = self.run.frame(0).shape[:2], self._record.asked.binning
        shown = [tone.of_picture(read_slm_levels(file)) for file in self.of[label]]
        seen = np.stack([self._record.map.seen(light, (shape[0], shape[1]), binning) for light in shown])
        return photographs, np.repeat(seen[:, None], photographs.shape[1], axis=1)

    def flicker(self) -> float:
        """Return the largest scatter of a picture's frames, relative to their light."""
        scatter = 0.0
        for frames in self.of[PICTURE].values():
            light = [self.run.frame(n).mean(dtype=np.float64) for n in frames]
            scatter = max(scatter, float(np.std(light, ddof=1) / self.mean(frames).mean()))
        return scatter

    def saturated(self) -> int:
        """Return how many frames have saturated pixels."""
        return sum(
            self.run.metadata(n).saturated_fraction > _HOT_SHARE
            for shown in self.of.values()
            for frames in shown.values()
            for n in frames
        )


def moved_meanwhile(again: Float32Array, white: Float32Array, *, binning: int) -> tuple[str, ...]:
    """Return in words how far white lies elsewhere in the end; nothing where noise hides its structure.

    Parameters
    ----------
    again, white : ndarray, float32, (height, width)
        Last and first.
    binning : int
        Pixels of the camera to one of theirs.
    """
    change = compare(again, white)
    moved_px = binning * change.shift_px
    if not np.isfinite(moved_px) or moved_px <= max(MOVED_PX, _SURE * binning * change.place_noise):
        return ()
    return (
        f"the picture moved by {moved_px:.1f} pixels during the run: clamp screen, diffuser and camera, let "
        "them warm up",
    )


def solving_work(asked: ScreenOptions, image: tuple[int, ...]) -> tuple[float, float]:
    """Return what solving and judging compute, in transforms of 1024 x 1024 there and back.

    ``image``: (n_channels, height, width) of a frame.
    """
    channels, height, width = image[0], *(n // asked.binning for n in image[1:])
    factor = max(1, height // _JUDGED_ROWS)
    judged_px = asked.judged * channels * (height // factor) * (width // factor)
    solver = _solver(asked)
    return psf_work((asked.pictures, channels, height, width), solver), 1e-6 * _JUDGING * judged_px


def _solver(asked: ScreenOptions) -> PictureSettings:
    return replace(_SOLVER, one_psf=not asked.channels)


def solve_screen(
    run: Run, record: ScreenRecord, on_progress: Callable[[str, float], object] | None = None
) -> ScreenCalibration:
    """Solve a complete run for the PSF, judge and save it; as :func:`finish_screen`."""
    asked, frames = record.asked, _Frames(run, record)
    report = on_progress or (lambda _what, _share: None)
    tones = frames.level(TONE)
    try:
        tone = ScreenTone.of(TONES, tones)
    except ValueError:
        counts = ", ".join(f"{level:.3g}" for level in tones)
        raise CalibrationError(
            f"The screen's light does not rise with its grey level ({counts} counts at levels "
            f"{', '.join(map(str, TONES))}): switch off dynamic contrast and night modes, and check that the "
            "camera sees the pictures."
        ) from None
    taken, shown = frames.pairs(PICTURE, tone)
    work = solving_work(replace(asked, binning=1), taken.shape[1:])
    part = work[0] / sum(work)
    solved = psf_from_pictures(
        taken, shown, _solver(asked), on_progress=lambda what, done: report(what, part * done)
    )
    judged: list[LeftOut] = []
    if asked.judged:
        photographs, pictures = frames.pairs(JUDGED, tone)
        factor = max(1, photographs.shape[2] // _JUDGED_ROWS)
        for photograph, picture in zip(photographs, pictures, strict=True):
            report("judging", part + (1 - part) * len(judged) / asked.judged)
            name = f"shapes {len(judged) + 1}"
            judged.append(judged_by(solved.psf, photograph, picture, name, factor))
    quality = {
        "marks": record.map.marks,
        "registration_px": record.map.misfit_px,
        "gamma": tone.gamma,
        "tone": list(zip(tone.levels, tone.light, strict=True)),
        "flicker": frames.flicker(),
        "drift": frames.level(AGAIN)[0] / tones[-1] - 1,
        "saturated_frames": frames.saturated(),
        "unsteady": frames.unsteady(),
    }
    made = {"bench": record.bench, "simulated": record.simulated, "run": str(run.path)}
    calibration, path = saved(
        run.path / SCREEN.result,
        solved,
        judged,
        asked.z_um,
        binned(record.geometry, asked.binning),
        quality,
        made,
        findings_of,
    )
    return ScreenCalibration(calibration, path, tone, tuple(findings_of(calibration.quality)))


def saved(
    path: Path,
    solved: PicturePsf,
    judged: Sequence[LeftOut],
    z_um: float | None,
    geometry: Geometry,
    quality: dict[str, Any],
    made: dict[str, Any],
    doubts: Callable[[Mapping[str, Any]], Sequence[str]],
) -> tuple[Calibration, Path]:
    """Save a PSF from known pictures as a calibration.

    Parameters
    ----------
    path : Path
        Its folder, where nothing makes it doubtful; CalibrationError as ``save_calibration``.
    solved : PicturePsf
    judged : sequence of LeftOut
        How pictures fare that it was not made from.
    z_um : float or None
        Of the pictures, from the diffuser.
    geometry : Geometry
    quality, made : dict
        What is to be kept besides, of how good it is and where it comes from.
    doubts : callable
        Says of the whole quality why the PSF is not to be relied on.
    """
    calibration = Calibration(
        psfs=solved.psf[None],
        source_positions_um=np.array([(0.0, 0.0, np.nan if z_um is None else z_um)]),
        geometry=geometry,
        quality={
            **quality,
            "misfit": solved.misfit,
            "wander": float(np.nanmax(np.abs(solved.brightness - 1))),
            "left_out": [one.to_json() for one in judged],
        },
        provenance={
            "made_by": f"diffuserbench {version('diffuserbench')}",
            "utc": datetime.now(UTC).isoformat(timespec="seconds"),
            "method": "photographs of known pictures, non-negative least squares",
            **made,
        },
    )
    named = named_by_worth(path, doubted=bool(doubts(calibration.quality)), overwrite=False)
    return calibration, save_calibration(calibration, named)


def psf_lines(quality: Mapping[str, Any]) -> list[str]:
    """Return what a PSF from known pictures explains, and how others fare with it, in lines."""
    lines = [f"PSF: leaves {quality['misfit']:.1%} of the photographs' standard deviation unexplained."]
    if quality["left_out"]:
        lines += ["Photographs that it was not made from, reconstructed, against their pictures:"]
    return lines + [
        f"  {one['name']:<12}{one['psnr_db']:.1f} dB (an even picture: {one['even_db']:.1f} dB)"
        for one in quality["left_out"]
    ]


def findings_of(quality: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with the screen's light, or with what the PSF explains, in words."""
    findings = []
    if quality["flicker"] > FLICKER:
        findings.append(
            f"the screen's light flickers by {quality['flicker']:.1%} from frame to frame: dim it, so that "
            "the exposure is longer than a few of its refreshes"
        )
    changed = max(abs(quality["drift"]), quality["wander"])
    if changed > DRIFT:
        findings.append(
            f"the screen's light, or other light, changed by {changed:.1%} during the run: let it warm up, "
            "switch off automatic brightness, darken the room"
        )
    if quality["saturated_frames"]:
        findings.append(f"{quality['saturated_frames']} frames have saturated pixels: dim the screen")
    findings += quality["unsteady"]
    if any(one["psnr_db"] < one["even_db"] + POOR_DB for one in quality["left_out"]):
        findings.append(
            "pictures that it was not made from are hardly reconstructed with it: did screen, diffuser or "
            "camera move, or did other light change?"
        )
    return findings


def screen_lines(done: ScreenCalibration) -> list[str]:
    """Return what was measured and how good it is, in lines."""
    quality, made = done.calibration.quality, done.calibration.provenance
    lines = ["SIMULATED: the photographs come from the simulated bench"] if made["simulated"] else []
    lines += [
        f"Screen: {quality['marks']} marks seen where they should be within {quality['registration_px']:.2f} "
        f"pixels; gamma {quality['gamma']:.2f}.",
        f"Light: steady within {quality['flicker']:.2%} from frame to frame, {quality['wander']:.2%} from "
        f"picture to picture (taken out) and {abs(quality['drift']):.2%} over the run.",
        *psf_lines(quality),
    ]
    return [*lines, *(f"Quality: {finding}." for finding in done.findings)]
