"""Photograph a pattern that is on the SLM: register the camera, judge, refine, keep what was seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.display.camera_in_the_loop import Refinement, refine_hologram
from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.hologram_capture import Capture, capture_hologram, find_camera
from instrument.bench.config import BenchConfig
from instrument.bench.display_setup import bench_display
from instrument.display.hologram_job import Envelope
from instrument.files.alignment_file import Alignment
from instrument.files.images import write_image
from instrument.files.slm_image import phase_levels, write_slm_image
from recon.holography import Display, Target

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Photographed:
    """What the camera saw of a hologram.

    Attributes
    ----------
    capture : Capture
        Of the pattern given, or of the best one where it was refined.
    refined : Refinement or None
    camera_residual_px : float
        Of the camera's registration.
    background_estimated : bool
        Rather than measured with the laser off.
    simulated : bool
    """

    capture: Capture
    refined: Refinement | None
    camera_residual_px: float
    background_estimated: bool
    simulated: bool


def display_of_pattern(
    config: BenchConfig,
    size: tuple[tuple[int, int], float],
    facts: Mapping[str, Any],
    alignment: Alignment | None = None,
) -> Display:
    """Return the bench's display as a pattern was computed for it, by the facts beside the pattern.

    ``size`` is the SLM's shape and pitch in micrometres. Errors as ``bench_display``.
    """
    display = bench_display(config, size, expansion=facts.get("expansion"))
    return display if alignment is None else alignment.of(display)


def envelope_of_pattern(facts: Mapping[str, Any]) -> Envelope:
    """Return how a pattern's target treated the mask pixels' envelope, by the facts beside the pattern."""
    envelope: Envelope = facts.get("metrics_computed_for", {}).get("envelope", "shade")
    return envelope


def photograph_hologram(
    io: DisplayBench,
    fields: Sequence[Array],
    display: Display,
    target: Target,
    *,
    average: int = 4,
    refine: int = 0,
    progress: Callable[[int, float], object] | None = None,
) -> Photographed:
    """Register the camera by the mask's speckle, photograph a hologram, and compare it with its target.

    Parameters
    ----------
    io : DisplayBench
    fields : sequence of ndarray, complex, (height, width)
        Time-multiplexed frames; one where it is to be refined.
    display : Display
        With the mask's displacement where it is known.
    target : Target
    average : int
        Photographs of each frame.
    refine : int
        Rounds with the camera in the loop.
    progress : callable, optional
        ``progress(round, psnr_db)``.

    Raises
    ------
    InputError
        When the speckle is not recognised.
    DeviceError
        When a device fails.
    """
    camera, mean_per_ms = find_camera(io, display)
    refined = None
    if refine:
        refined = refine_hologram(
            io,
            np.asarray(fields[0])[None],
            display,
            target,
            camera,
            mean_per_ms=mean_per_ms,
            rounds=refine,
            average=average,
            progress=progress,
        )
        capture = refined.best
    else:
        capture = capture_hologram(
            io, fields, display, target, camera, mean_per_ms=mean_per_ms, average=average
        )
    return Photographed(
        capture, refined, camera.residual_px, io.estimates_background, bool(io.bench.simulated_kinds)
    )


def write_refined(pattern: Path, refined: Refinement, facts: Mapping[str, Any], binning: int) -> Path:
    """Write the refined pattern beside the one it came from, and return its path."""
    path = pattern.with_name(f"{pattern.stem}-refined.png")
    kept = {name: fact for name, fact in facts.items() if name not in ("format", "levels_per_turn")}
    kept |= {"refined_by_camera": True, "captured_psnr_db": list(refined.psnr_db)}
    write_slm_image(path, phase_levels(np.angle(refined.slm[0]), binning), kept)
    return path


def write_capture(path: Path, found: Photographed) -> None:
    """Write what was seen as an 8-bit image, white at 255, and its metrics beside it."""
    pixels = np.clip(np.rint(found.capture.seen * 255), 0, 255).astype(np.uint8)
    facts = {
        "simulated": found.simulated,
        "background": "estimated" if found.background_estimated else "measured",
        "metrics": asdict(found.capture.scores),
        "camera_residual_px": found.camera_residual_px,
    }
    write_image(path, pixels, {**facts, "low_passed": True, "white": 255})
