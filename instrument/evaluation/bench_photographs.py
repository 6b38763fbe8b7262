"""What the simulated microscope photographs for a chart of calibrations: points, beads, two scenes.

Light is propagated by wave optics for every point, bead and picture at its own place; each photograph has
read noise 34 dB below its peak (as the bead images of Kuo 2020, Fig. 5.4). The aperture is small and its
lenslets are fine, so that the whole pattern falls on the sensor over the field.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from instrument.files.atomic import check_writable, whole_file
from instrument.files.errors import FileError
from instrument.files.sample_images import SAMPLES
from recon.arrays import Array, Float32Array
from recon.evaluation.chart_calibration import FINE, SCENES, Photographed, Photographs
from recon.optics.scene import Scene, bead_volume, picture
from recon.types import Geometry

VERSION = 2
GREEN = (0.0, 1.0, 0.0)
Z_UM = 2500.0
DEPTHS_UM = (2000.0, 10_000 / 3)
"""Of calibrations at several depths; their harmonic mean is ``Z_UM``."""
BEADS_UM = (2050.0, 3200.0)
"""Of the beads in depth: within the calibrated depths, none at one of them but by chance."""
DEPTHS = 9
GRID = 5
SLIDES = 9
AVERAGED = 25
PSNR_DB = 34.0
REACH = 0.42
"""Part of the sensor's sides where beads, PSFs and scenes are."""
APERTURE_MM = 0.5
MARGIN = 1.12
"""The diffuser bends light a little beyond the aperture's shadow."""

KEEP_S = 10.0
"""Seconds of photographs that may be lost to a power cut."""
_KEEPING_SHARE = 0.05
"""Part of the time that may go into keeping them."""

Advance = Callable[[int, int], object]


class OutOfTimeError(Exception):
    """There was no time for all photographs; those taken are kept."""

    def __init__(self, done: int, total: int) -> None:
        super().__init__(f"{done} of {total} photographs were taken.")
        self.done, self.total = done, total


def photographs(size: int, path: Path, advance: Advance, *, budget_s: float = np.inf) -> Photographs:
    """Return the photographs: those that a file holds already, and the others, taken now and kept there.

    They are kept as they are taken, and are the same however often that was interrupted.

    Raises OutOfTimeError when the time was not enough: the next call goes on. Raises FileError when the file
    holds something else.

    Parameters
    ----------
    size : int
        Pixels of the sensor's side, about: the camera bins by a whole number.
    path : Path
        An ``.npz`` file.
    advance : callable
        Called with how many photographs are done, and how many there are.
    budget_s : float
        Seconds after which no other photograph is begun; one is taken in any case.
    """
    bench = _Bench(size)
    shots = _shots(bench)
    kept = _Kept(path, bench.key, shots)
    if path.exists():
        kept.read(bench.size)
    check_writable(path)
    ends = time.monotonic() + budget_s
    rng = np.random.default_rng(0)
    before = len(kept.images)
    try:
        for place, shot in enumerate(shots):
            # Drawn for those that are kept, too: the others' noise does not depend on interruptions.
            noise = rng.normal(0, 10 ** (-PSNR_DB / 20), (bench.size, bench.size))
            if place < before:
                continue
            if place > before and time.monotonic() > ends:
                raise OutOfTimeError(place, len(shots))
            light = shot.light()
            truth = bench.truth() if shot.is_scene else None
            kept.add(np.asarray(light / light.max() + noise, np.float32), truth)
            advance(place + 1, len(shots))
    finally:
        kept.write()
    return kept.sorted(bench)


@dataclass(frozen=True)
class _Shot:
    """One photograph: of a point at a place (row, column, depth), or else of a slide or scene."""

    light: Callable[[], Array]
    place: tuple[float, float, float] | None = None
    is_scene: bool = False


class _Kept:
    """Photographs and truths in the order in which they are taken, and the file that keeps them."""

    def __init__(self, path: Path, key: str, shots: Sequence[_Shot]) -> None:
        self.path, self.key, self.shots = path, key, shots
        self.images: list[Float32Array] = []
        self.truths: list[Float32Array] = []
        self._written = 0
        self._due = time.monotonic() + KEEP_S

    def add(self, image: Float32Array, truth: Float32Array | None) -> None:
        # The truth first: what is written has one for every scene, wherever an interruption comes.
        self.truths += [] if truth is None else [truth]
        self.images.append(image)
        if time.monotonic() > self._due:
            self.write()

    def write(self) -> None:
        if len(self.images) == self._written:
            return
        began = time.monotonic()
        count = len(self.images)
        truths = np.array(self.truths[: self._scenes(count)])
        with whole_file(self.path) as temporary, temporary.open("wb") as file:
            np.savez(file, key=self.key, images=np.stack(self.images), truths=truths)
        self._written = count
        spent = time.monotonic() - began
        self._due = began + spent + max(KEEP_S, spent / _KEEPING_SHARE)

    def read(self, side: int) -> None:
        try:
            with self.path.open("rb") as opened, np.load(opened) as file:
                if str(file["key"]) != self.key:
                    raise self._unusable("holds photographs of another size or version")
                images, truths = file["images"], file["truths"]
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise self._unusable(f"holds no photographs ({error})") from error
        count, fine = len(images), FINE * side
        scenes = self._scenes(count)
        fits = 0 < count <= len(self.shots) and len(truths) == scenes
        if not (
            fits and images.shape[1:] == (side, side) and (not scenes or truths.shape[1:] == (fine, fine))
        ):
            raise self._unusable(
                f"holds photographs {images.shape} and truths {truths.shape}, which do not fit together"
            )
        self.images, self.truths = list(images), list(truths)
        self._written = count

    def sorted(self, bench: _Bench) -> Photographs:
        shot = list(zip(self.shots, self.images, strict=True))
        scenes = [image for s, image in shot if s.is_scene]
        return Photographs(
            np.stack([image for s, image in shot if s.place is not None]),
            np.array([s.place for s in self.shots if s.place is not None]),
            np.stack([image for s, image in shot if s.place is None and not s.is_scene]),
            tuple(Photographed(*scene) for scene in zip(SCENES, scenes, self.truths, strict=True)),
            Z_UM,
            bench.geometry,
            bench.window_px,
            REACH,
        )

    def _scenes(self, count: int) -> int:
        return sum(shot.is_scene for shot in self.shots[:count])

    def _unusable(self, why: str) -> FileError:
        return FileError(self.path, f"{why}.", "Delete it, or name another folder with --out.")


class _Bench:
    """The simulated camera at one binning, cropped to a square."""

    def __init__(self, size: int) -> None:
        options = WorldOptions.model_validate(
            {"preset": "microscope", "aperture_mm": (APERTURE_MM, APERTURE_MM), "lenslet_um": 100.0}
        )
        self.world = SimulatedWorld(options)
        self.binning = max(round(self.world.sensor.shape[0] / size), 1)
        self.size = self.world.sensor.shape[0] // self.binning
        self.pitch_um = self.world.sensor.pitch_um * self.binning
        fixed = (Z_UM, DEPTHS_UM, BEADS_UM, DEPTHS, GRID, SLIDES, AVERAGED, PSNR_DB, REACH, APERTURE_MM)
        self.key = f"{VERSION} {self.binning} {fixed}"

    @property
    def geometry(self) -> Geometry:
        return Geometry(self.pitch_um, 1e-3 * self.world.distance_um)

    @property
    def window_px(self) -> int:
        shadow_um = 1e3 * APERTURE_MM * (1 + self.world.distance_um / Z_UM)
        return round(MARGIN * shadow_um / self.pitch_um) // 2 * 2 + 1

    @property
    def field_um(self) -> float:
        """Side of the field at ``Z_UM``."""
        return REACH * self.size * self.pitch_um * Z_UM / self.world.distance_um

    def psf(self, row: float, column: float, z_um: float) -> np.ndarray[Any, Any]:
        object_um = self.pitch_um * z_um / self.world.distance_um
        place = (-column * object_um, -row * object_um, z_um)
        return self._square(self.world.psf(place, GREEN, self.binning))

    def photographed(self, scene: Scene) -> np.ndarray[Any, Any]:
        self.world.set_scene(scene)
        self.world.scene_lit = True
        light = self.world.photons_per_s(GREEN, self.binning)
        assert light is not None
        return self._square(light)

    def truth(self) -> np.ndarray[Any, Any]:
        """Of the scene that was photographed last."""
        side = FINE * self.size
        return self.world.ground_truth((side, side), self.pitch_um / FINE, collected=True)

    def _square(self, image: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        height, width = image.shape
        left = width // 2 - height // 2
        return np.array(image[:, left : left + height])


def _shots(bench: _Bench) -> list[_Shot]:
    """Return all photographs, in the order in which they are taken: points, slides, the two scenes."""
    along = np.round(np.linspace(-0.5, 0.5, GRID) * REACH * bench.size)
    depths = 1 / np.linspace(1 / DEPTHS_UM[1], 1 / DEPTHS_UM[0], DEPTHS)
    depths[DEPTHS // 2] = Z_UM  # but for rounding it is that
    places = [(float(r), float(c), float(z)) for z in depths for r in along for c in along]
    shots = [_Shot(partial(bench.psf, *place), place) for place in places]
    centre = cache(partial(bench.psf, 0.0, 0.0, Z_UM))
    shots += [_Shot(centre, (0.0, 0.0, Z_UM))] * (AVERAGED - 1)
    field = (bench.field_um, bench.field_um)

    def beads(count: int, field: tuple[float, float], depths: tuple[float, float], seed: int) -> Any:
        return bench.photographed(bead_volume(count, field, depths, seed=seed))

    def flat() -> Any:
        portrait = SAMPLES["portrait"].load()[:512, :512]
        return bench.photographed(picture(portrait, Z_UM, bench.field_um))

    shots += [_Shot(partial(beads, 20, field, (Z_UM, Z_UM), 100 + n)) for n in range(SLIDES)]
    near = bench.field_um * BEADS_UM[0] / Z_UM
    shots.append(_Shot(flat, is_scene=True))
    shots.append(_Shot(partial(beads, 40, (near, near), BEADS_UM, 7), is_scene=True))
    return shots
