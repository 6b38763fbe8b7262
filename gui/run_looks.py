"""What a run or a photograph has to show: read in jobs, for the panel of runs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration_routines.optics.photograph import PHOTOGRAPH
from calibration_routines.plan_procedures import can_go_on, why_no_result
from calibration_routines.psf.sweep_plan import SWEEP
from drivers.frame import FrameMetadata
from gui.widgets.image_view import usual_levels
from gui.words import quantity
from instrument.bench.photograph import Progress
from instrument.bench.photograph_file import read_snapshot
from instrument.files.errors import percent
from instrument.files.images import read_image
from instrument.runs.inspection import Verification, verify
from instrument.runs.run import Run
from recon.arrays import Array


@dataclass(frozen=True, slots=True)
class Opened:
    """A run that was read, or a photograph: that has no run."""

    path: Path
    run: Run | None
    stored: list[int]
    about: list[str]
    can_resume: bool
    to_use: Path | None
    """The calibration or the photograph that it holds or is; None where it is neither."""

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.path.parent if self.run is None else self.path


@dataclass(frozen=True, slots=True)
class Picture:
    """A frame that was read, with its levels and what is said of it."""

    image: Array
    low: float
    high: float
    full_scale: int
    words: str


def look_into(path: Path, *, read: bool = False, on_progress: Progress | None = None) -> Opened | str:
    """Read a run, with ``read`` every frame of it, or a photograph; the reason where it cannot be read."""
    try:
        if path.is_file():
            return Opened(path, None, [0], _about_photograph(path), False, path)
        run = Run.open(path)
        looked = verify(run, on_progress, read=read)
        about = _about_run(run, looked)
        if read:
            about.insert(1, f"{looked.frames} of {_taken(looked)} frames read back are as they were written")
        held = (SWEEP.kept(path), PHOTOGRAPH.kept(path))
        to_use = next((each for each in held if each.exists()), None)
        return Opened(path, run, sorted(run.records), about, can_go_on(run, looked), to_use)
    except Exception as error:  # noqa: BLE001 - whatever a damaged folder raises is shown
        return str(error)


def read_frame(opened: Opened, index: int) -> Picture | str:
    """Read a frame, or the photograph; the reason where it cannot be read."""
    run = opened.run
    try:
        if run is None:
            taken = read_snapshot(opened.path)
            return _picture("Photograph", taken.image, taken.metadata)
        image, metadata = run.frame(index), run.metadata(index)
    except Exception as error:  # noqa: BLE001 - a damaged file is named, whatever it raises
        return str(error)
    steps = run.steps() if run.plan is not None else []
    what = f" ({steps[index].label})" if index < len(steps) else ""
    return _picture(f"Frame {index} of {run.n_frames}{what}", image, metadata)


def _picture(what: str, image: Array, metadata: FrameMetadata) -> Picture:
    low, high = usual_levels(image)
    words = [
        what,
        f"{metadata.utc.astimezone():%H:%M:%S}",  # the run's name has the day
        quantity(metadata.exposure_ms, "ms"),
        f"LEDs: {metadata.led_pattern}" if metadata.led_pattern else "",
    ]
    place = ", ".join(_axis_words(axis, value) for axis, value in (metadata.stage_position or {}).items())
    return Picture(
        image,
        low,
        high,
        (1 << metadata.significant_bits) - 1,
        ", ".join(word for word in (*words, place) if word),
    )


def _axis_words(axis: str, value: float) -> str:
    """Return an axis' name without its unit, and its value with it: ``x 100 µm``."""
    name, _, unit = axis.rpartition("_")
    return f"{name} {quantity(value, unit, 6)}" if name else f"{axis} {value:g}"


def _about_photograph(path: Path) -> list[str]:
    """Return what is known of a photograph, a line each."""
    image = read_image(path)
    said = image.metadata
    lines = [image.describe() + ("  SIMULATED" if image.is_simulated else "")]
    names = {"bench": "Bench", "camera": "Camera", "light": "Light", "average": "Frames averaged"}
    lines += [f"{name}: {said[key]}" for key, name in names.items() if said.get(key) not in (None, "")]
    share = said.get("saturated_fraction")
    return [*lines, *([f"Saturated: {percent(share)} of its pixels"] if share else []), str(path)]


def _about_run(run: Run, looked: Verification) -> list[str]:
    """Return what is known of a run, a line each."""
    lines = [f"{looked.became}: {_taken(looked)} of {run.n_frames} frames taken"]
    lines[0] += f", {len(run.unlisted)} of them without metadata" if run.unlisted else ""
    lines[0] += "  SIMULATED" if run.is_simulated else ""
    if run.error:
        lines.append(run.error)
    lines += [f"DAMAGED: {line}" for line in looked.lines()]
    lines += [looked.remedy().replace("diffuserbench resume", "Resume")] if looked.remedy() else []
    if run.plan is not None:
        parts: dict[str, int] = {}
        for part in run.plan.parts:
            parts[part.label] = parts.get(part.label, 0) + len(part)
        lines.append(f"Plan {run.plan.label}: " + ", ".join(f"{n} {label}" for label, n in parts.items()))
    devices = run.provenance.get("devices")
    if isinstance(devices, Mapping):
        lines += [f"{kind}: {identity}" for kind, identity in devices.items()]
    if refused := why_no_result(run.path):
        lines.append(f"Its frames give no result: {refused}")
    if SWEEP.is_of(run.path):
        lines += _calibration_lines(run.path)
    return [*lines, str(run.path)]


def _taken(looked: Verification) -> int:
    """Return how many images there should be, with those whose line in the log is lost."""
    return looked.frames + len(looked.damaged)


def _calibration_lines(run: Path) -> list[str]:
    file = SWEEP.kept(run) / "calibration.json"
    if not file.is_file():
        return ["A sweep without its calibration: Resume makes it."]
    try:
        quality: dict[str, Any] = json.loads(file.read_text("utf-8"))["quality"]
        psfs = quality["psfs"]
        findings = [f"z = {q['z_um'] / 1e3:.4g} mm: {text}" for q in psfs for text in q["findings"]]
        verdict = "good" if quality["good"] else "with findings"
    except (OSError, ValueError, KeyError, TypeError) as error:
        return [f"Calibration {file.parent} cannot be read: {error!r}"]
    return [f"Calibration {file.parent}: {len(psfs)} PSFs, {verdict}", *findings]
