"""What the simulated microscope photographs for a chart of calibrations: points, beads, two scenes.

Light is propagated by wave optics for every point, bead and picture at its own place; each photograph has
read noise 34 dB below its peak (as the bead images of Kuo 2020, Fig. 5.4). The aperture is small and its
lenslets are fine, so that the whole pattern falls on the sensor over the field.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from instrument.atomic import whole_file
from instrument.errors import FileError
from instrument.sample_images import SAMPLES
from recon.chart.calibration import FINE, SCENES, Photographed, Photographs
from recon.optics.scene import Scene
from recon.optics.scenes import bead_volume, picture
from recon.types import Geometry

VERSION = 1
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

Advance = Callable[[int, int], object]


def photographs(size: int, path: Path, advance: Advance) -> Photographs:
    """Return the photographs, from a file that holds them already, or taken now and kept there.

    Parameters
    ----------
    size : int
        Pixels of the sensor's side, about: the camera bins by a whole number.
    path : Path
        An ``.npz`` file.
    advance : callable
        Called with how many photographs are done, and how many there are.

    Raises
    ------
    FileError
        When the file holds something else.
    """
    bench = _Bench(size)
    if path.exists():
        return _read(path, bench)
    taken = _taken(bench, advance)
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            key=bench.key,
            psfs=taken.psfs,
            places=taken.places,
            slides=taken.slides,
            images=np.stack([scene.image for scene in taken.scenes]),
            truths=np.stack([scene.truth for scene in taken.scenes]),
        )
    return taken


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


def _taken(bench: _Bench, advance: Advance) -> Photographs:
    rng = np.random.default_rng(0)
    total = DEPTHS * GRID**2 + AVERAGED - 1 + SLIDES + 2
    done = 0

    def noisy(image: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        nonlocal done
        done += 1
        advance(done, total)
        noise = rng.normal(0, 10 ** (-PSNR_DB / 20), image.shape)
        return np.asarray(image / image.max() + noise, np.float32)

    along = np.round(np.linspace(-0.5, 0.5, GRID) * REACH * bench.size)
    depths = 1 / np.linspace(1 / DEPTHS_UM[1], 1 / DEPTHS_UM[0], DEPTHS)
    depths[DEPTHS // 2] = Z_UM  # but for rounding it is that
    places = [(r, c, z) for z in depths for r in along for c in along]
    psfs = [noisy(bench.psf(*place)) for place in places]
    centre = bench.psf(0.0, 0.0, Z_UM)
    places += [(0.0, 0.0, Z_UM)] * (AVERAGED - 1)
    psfs += [noisy(centre) for _ in range(AVERAGED - 1)]
    field = (bench.field_um, bench.field_um)
    slides = [
        noisy(bench.photographed(bead_volume(20, field, (Z_UM, Z_UM), seed=100 + n))) for n in range(SLIDES)
    ]
    portrait = SAMPLES["portrait"].load()[:512, :512]
    flat = noisy(bench.photographed(picture(portrait, Z_UM, bench.field_um)))
    flat_truth = bench.truth()
    near = bench.field_um * BEADS_UM[0] / Z_UM
    deep = noisy(bench.photographed(bead_volume(40, (near, near), BEADS_UM, seed=7)))
    return Photographs(
        np.stack(psfs),
        np.array(places),
        np.stack(slides),
        (
            Photographed(SCENES[0], flat, flat_truth),
            Photographed(SCENES[1], deep, bench.truth()),
        ),
        Z_UM,
        bench.geometry,
        bench.window_px,
        REACH,
    )


def _read(path: Path, bench: _Bench) -> Photographs:
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            kept = dict(file)
        if str(kept["key"]) != bench.key:
            raise FileError(
                path, "holds photographs of another size or version.", "Name another folder with --out."
            )
        return Photographs(
            kept["psfs"],
            kept["places"],
            kept["slides"],
            tuple(
                Photographed(name, image, truth)
                for name, image, truth in zip(SCENES, kept["images"], kept["truths"], strict=True)
            ),
            Z_UM,
            bench.geometry,
            bench.window_px,
            REACH,
        )
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise FileError(
            path, f"holds no photographs ({error}).", "Delete it, or name another folder."
        ) from error
