"""A video's reconstruction as files: what every worker needs, and what is done, beside the output.

``.NAME.job/`` stands beside ``NAME.ome.zarr`` until the video is complete::

    job.json      the recording, the frames, the blocks, every setting
    camera.npz    PSFs, dark level, and the first frame, which settles noise and weights for all workers alike
    done/         a file for each block whose pictures are on the disk: how many of its frames had no light

A worker needs the job's folder and a block's number, nothing else: it reads frames and writes pictures.
A block that was cut off is computed again from its start, as its pictures hang together; those that are on
the disk already are left as they are.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import sync_folder, whole_file
from instrument.files.errors import FileError
from instrument.files.ome_zarr import stem_of
from instrument.files.record import RecordFormat, plain
from instrument.reconstruction.job import Reduction
from instrument.reconstruction.mosaic import mosaic_named
from instrument.reconstruction.preparation import Crop
from recon.arrays import Array
from recon.base.declare import record
from recon.base.noise import NoiseModel
from recon.camera.camera_model import Extent
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.streams.joint import OverTimeName
from recon.streams.video import stream_problem
from recon.types import Calibration, Geometry

_VIDEO_JOB = RecordFormat(
    "diffuserbench video job", "video job", restore="Begin anew with --force.", numbered_before=True
)
_JSON, _CAMERA, _DONE = "job.json", "camera.npz", "done"


@dataclass(frozen=True)
class VideoPlan:
    """What shall be computed, as plain data; two jobs are one when their plans are equal."""

    run: str
    """The recording's folder, absolute."""
    frames: tuple[int, ...]
    """The recording's frames that there are, ascending."""
    n_frames: int
    """Frames of the output: the recording's, with its gaps."""
    block: int
    """Frames a block, by number."""
    cold_iterations: int
    warm_iterations: int
    over_time: OverTimeName | None
    """A prior over time, with which the frames of a block are solved together (then ``cold_iterations``)."""
    rotate_deg: int
    """By how much pictures are turned, counter-clockwise."""
    picture_shape: tuple[int, ...]
    """``([n_z,] height, width[, 3])``, before turning; without depths where there is one."""
    settings: dict[str, Any]
    """Everything that was chosen for preparation and prior, JSON-compatible."""


class VideoJob:
    """A job's folder.

    ``folder``: of a job that exists; :meth:`create` makes one.

    Raises FileError when there is none, or it is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not (folder / _JSON).exists():
            raise FileError(folder, "holds no unfinished video.", "Was it completed meanwhile?")
        self.plan = _VIDEO_JOB.value(VideoPlan, _VIDEO_JOB.read(folder / _JSON), folder / _JSON)

    @staticmethod
    def folder_of(output: Path) -> Path:
        """Return where the job for an output lies."""
        return output.with_name(f".{stem_of(output)}.job")

    @classmethod
    def create(
        cls,
        output: Path,
        plan: VideoPlan,
        problem: Problem,
        reduction: Reduction,
        times_noise: float | None = None,
    ) -> VideoJob:
        """Write a job beside its output; ``job.json``, which makes it one, comes last.

        ``times_noise``: the prior's weight as the first frame tells it, so that no worker looks again.
        """
        folder = cls.folder_of(output)
        (folder / _DONE).mkdir(parents=True)
        arrays: dict[str, Any] = {
            **_problem_arrays(problem),
            "dark": np.asarray(reduction.dark, np.float32),
            "binning": np.array([reduction.first_binning, reduction.binning]),
            "crop": _crop_array(reduction.crop),
            "mosaic": np.array(reduction.mosaic or ""),
            "times_noise": np.array(np.nan if times_noise is None else times_noise),
        }
        with whole_file(folder / _CAMERA) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)
        _VIDEO_JOB.write(folder / _JSON, plain(plan))
        return cls(folder)

    def goes_on_without(self, plan: VideoPlan) -> list[int] | None:
        """Return the blocks that begin anew where ``plan`` is this one's but for frames lost since.

        None where more differs, or no frame of a block is left: then the others would have other numbers.
        """
        frames = self.plan.frames
        alike = plain(replace(plan, frames=frames)) == plain(self.plan) and set(plan.frames) <= set(frames)
        ours, theirs = (_blocks(p.frames, p.block) for p in (self.plan, plan))
        if not alike or len(ours) != len(theirs):
            return None
        return [number for number, (one, other) in enumerate(zip(ours, theirs, strict=True)) if one != other]

    def go_on_without(self, plan: VideoPlan, anew: Sequence[int]) -> None:
        """Take a plan of fewer frames; the blocks ``anew`` are to be computed again."""
        for number in anew:
            (self.folder / _DONE / str(number)).unlink(missing_ok=True)
        sync_folder(self.folder / _DONE)
        _VIDEO_JOB.write(self.folder / _JSON, plain(plan))
        self.plan = plan

    def remove(self) -> None:
        """Delete the job, whose video is complete."""
        (self.folder / _JSON).unlink()
        shutil.rmtree(self.folder)

    # What to do, and what is done ------------------------------------------------------------------
    @property
    def blocks(self) -> list[tuple[int, ...]]:
        """The frames of each block: numbers ``n block <= index < (n + 1) block``.

        By number and not by count, so that blocks stay what they are when frames are missing or added.
        """
        return _blocks(self.plan.frames, self.plan.block)

    def done(self) -> set[int]:
        """Return the numbers of the blocks whose pictures are on the disk."""
        return {int(path.name) for path in (self.folder / _DONE).iterdir()}

    def is_done(self, block: int) -> bool:
        """Whether a block's pictures are on the disk."""
        return (self.folder / _DONE / str(block)).exists()

    def unlit(self) -> int:
        """Return how many frames of the blocks that are done hold nothing but noise."""
        return sum(int(path.read_text() or 0) for path in (self.folder / _DONE).iterdir())

    def mark_done(self, block: int, unlit: int = 0) -> None:
        """Note that a block's pictures are on the disk, and how many of its frames had no light."""
        (self.folder / _DONE / str(block)).write_text(str(unlit))
        sync_folder(self.folder / _DONE)

    # What workers need -----------------------------------------------------------------------------
    @cached_property
    def _arrays(self) -> dict[str, Array]:
        with np.load(self.folder / _CAMERA) as file:
            return dict(file)

    @cached_property
    def problem(self) -> Problem:
        """The first frame's problem: the same for every worker."""
        a = self._arrays
        asked = json.loads(str(a["options"]))
        noise = a["noise"].tolist()
        measurement = Measurement(
            a["frame"],
            NoiseModel(*noise) if len(noise) == 2 else noise[0] if noise else None,
            erasures=a["erasures"] if a["erasures"].size else None,
        )
        pitch_um, distance_mm = (None if np.isnan(v) else float(v) for v in a["geometry"])
        calibration = Calibration(a["psfs"], a["positions"], geometry=Geometry(pitch_um, distance_mm))
        extent = None
        if a["extent"].size:
            height, width, *limits = a["extent"].tolist()
            reach, margin = (None if np.isnan(x) else float(x) for x in (*limits, np.nan)[:2])
            extent = Extent((int(height), int(width)), reach, margin)  # jobs of before have no margin
        options = ReconstructionOptions(**asked)
        return stream_problem(measurement, calibration, options, choosing=False, extent=extent)

    @property
    def times_noise(self) -> float | None:
        """The prior's weight in units of the noise; None where it is the table's or is yet to be found."""
        weight = float(self._arrays.get("times_noise", np.nan))  # none in jobs of before
        return None if np.isnan(weight) else weight

    @property
    def reduction(self) -> Reduction:
        """From a frame to what the solver takes."""
        a = self._arrays
        first, last = (int(n) for n in a["binning"])
        dark = a["dark"] if a["dark"].ndim else float(a["dark"])
        crop = Crop(*(int(n) for n in a["crop"])) if a["crop"].size else None
        mosaic = mosaic_named(str(a.get("mosaic", "")) or "none")  # none in jobs of before
        assert mosaic != "auto"
        return Reduction(first, dark, crop, last, mosaic)


def _blocks(frames: Sequence[int], block: int) -> list[tuple[int, ...]]:
    return [tuple(of_one) for _, of_one in groupby(frames, lambda index: index // block)]


def _problem_arrays(problem: Problem) -> dict[str, Any]:
    """Return all that a problem is made of again."""
    measurement, geometry = problem.measurement, problem.calibration.geometry
    noise = measurement.noise
    known = [] if noise is None else [noise] if isinstance(noise, float | int) else asdict(noise).values()
    asked = {name: value for name, value in record(problem.options).items() if value is not None}
    optics = (geometry.pixel_pitch_um, geometry.diffuser_distance_mm)
    window, limits = problem.extent.psf_window, (problem.extent.acceptance_px, problem.extent.margin)
    extent = [] if window is None else [*window, *(np.nan if limit is None else limit for limit in limits)]
    return {
        "frame": np.asarray(measurement.image),
        "noise": np.array(list(known), float),
        "erasures": np.zeros(0, bool) if measurement.erasures is None else np.asarray(measurement.erasures),
        "psfs": problem.calibration.psfs,
        "positions": problem.calibration.source_positions_um,
        "geometry": np.array([np.nan if value is None else value for value in optics]),
        "options": np.array(json.dumps(asked)),
        "extent": np.array(extent, float),
    }


def _crop_array(crop: Crop | None) -> npt.NDArray[np.int64]:
    """Return a window as (top, left, height, width); empty for none. Callers settle a centred one before."""
    if crop is None:
        return np.zeros(0, np.int64)
    assert crop.top is not None
    assert crop.left is not None
    return np.array([crop.top, crop.left, crop.height, crop.width])
