"""How many photographs a calibration takes, against the error of what is reconstructed with it.

The photographs are made beforehand, by a bench whose scenes are known: one PSF, PSFs along the axis, on a
grid over the field, grids at several depths, and slides of beads at unknown places. Each setting makes a
calibration of some of them, and reconstructs two scenes: a flat picture at the depth of most calibrations,
and beads at all depths, which are judged as one picture in which everything is in focus. PSFs have the light
that their distance asks for, and are set to zero where they show none above their noise, however they were
found. A blind calibration has no zero: a shift of the whole picture is no error.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float32Array, Float64Array
from recon.base.metrics import ssim
from recon.blind import BlindSettings, calibrate_from_beads
from recon.blind.points import support_of
from recon.camera.registration import displacement
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.evaluation.scored import Aside, Curve, Point
from recon.evaluation.trial import Subject, Turn, in_turns
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.result import Reconstruction
from recon.types import Calibration, Geometry

SceneName = Literal["flat picture", "beads at all depths"]
SCENES: tuple[SceneName, SceneName] = ("flat picture", "beads at all depths")

FINE = 5
"""The truth's pixels along one of the measurement's: odd, so that both grids have a pixel on the axis."""
ITERATIONS = 150
BLIND = BlindSettings(ranks=(1, 2), iterations=50)
_SEARCH = 3


@dataclass(frozen=True)
class Photographed:
    """A scene's photograph and what is true."""

    name: SceneName
    image: Float32Array
    """(height, width)."""
    truth: Float32Array
    """(FINE * height, FINE * width): light from all depths that reaches the sensor; the axis in the
    middle."""


@dataclass(frozen=True)
class Photographs:
    """What a bench photographed; all of (height, width), float32, background removed, noise kept."""

    psfs: Float32Array
    """(n, height, width): of the point source at ``places``, one photograph each; several of the same place
    differ in noise."""
    places: Float64Array
    """(n, 3): row and column from the axis in object pixels, and depth in micrometres."""
    slides: Float32Array
    """(m, height, width): of beads at unknown places in depth ``z_um``."""
    scenes: tuple[Photographed, ...]
    z_um: float
    """Depth of the flat picture, of the slides, and of calibrations of one depth."""
    geometry: Geometry
    window_px: int
    """Side of the square that holds a PSF of ``z_um``; odd."""
    reach: float
    """Part of the sensor's sides that scenes, grids and beads cover."""


@dataclass(frozen=True, slots=True)
class CalibrationSetting:
    """One way to calibrate."""

    grid: int = 1
    """Points along each side of the field; 1: on the axis."""
    depths: int = 1
    averaged: int = 1
    """Photographs a place, whose mean is taken."""
    slides: int = 0
    """Of beads, for a blind calibration, which photographs no point; else 0."""

    @property
    def images(self) -> int:
        """Number of photographs."""
        return self.slides or self.grid**2 * self.depths * self.averaged

    @property
    def family(self) -> str:
        """What is photographed."""
        if self.slides:
            return "blind, from beads"
        if self.grid > 1:
            return f"{self.grid} x {self.grid}" + (", several depths" if self.depths > 1 else "")
        return "axial" if self.depths > 1 else "one PSF"

    @property
    def name(self) -> str:
        """Say it briefly."""
        if self.slides:
            return f"blind, {self.slides} slides"
        first = f"{self.grid} x {self.grid}" if self.grid > 1 else "axial" if self.depths > 1 else "one PSF"
        depths = f", {self.depths} depths" if self.depths > 1 else ""
        return first + depths + (f", mean of {self.averaged}" if self.averaged > 1 else "")


@dataclass(frozen=True, eq=False)
class CalibrationProblem(Subject[CalibrationSetting]):
    """Photographs from which calibrations are made, and scenes to judge them on.

    A blind calibration that finds no beads is an InputError of its run.
    """

    kind = "calibration"

    photographs: Photographs

    @property
    def pixels(self) -> tuple[int, ...]:
        """Of the sensor."""
        return self.photographs.psfs.shape[1:]

    def settings(self) -> tuple[CalibrationSetting, ...]:
        """Return what can be made of the photographs, few ones first, blind ones last."""
        depths = len(self._depths_um())
        fewer = sorted({n for n in (3, 5, depths) if n > 1 and (depths - 1) % (n - 1) == 0})
        grids = sorted({n for n in (3, 5) if n <= self._grid()})
        central = self._at(0.0, 0.0, self.photographs.z_um)
        means = [n for n in (1, 9, 25) if n <= len(central)]
        found = [CalibrationSetting(averaged=n) for n in means]
        found += [CalibrationSetting(depths=n) for n in fewer]
        found += [CalibrationSetting(grid=g) for g in grids]
        found += [CalibrationSetting(grid=g, depths=n) for g in grids for n in fewer]
        slides = len(self.photographs.slides)
        blind = [CalibrationSetting(slides=n) for n in sorted({3, 5, slides}) if 2 <= n <= slides]
        return (*sorted(found, key=lambda s: s.images), *blind)

    def _curve(self, setting: CalibrationSetting, limit_s: float | None, aside: Aside) -> Curve:
        """Calibrate and reconstruct every scene."""
        began = time.perf_counter()
        try:
            calibration = self._calibrated(setting, None if limit_s is None else began + limit_s)
        except _OutOfTime:
            return Curve((), finished=False)
        spent = time.perf_counter() - began
        turns = (self._turn(setting, calibration, scene, spent) for scene in self.photographs.scenes)
        return in_turns(turns, None if limit_s is None else limit_s - spent, aside)

    def _turn(
        self, setting: CalibrationSetting, calibration: Calibration, scene: Photographed, spent_s: float
    ) -> Turn:
        flat = scene.name == "flat picture"

        def reconstructed(left_s: float | None) -> Reconstruction:
            # Total variation for what is extended, l1 for what is sparse.
            given = self._flat(calibration) if flat else calibration
            return _reconstructed(
                scene.image, given, setting, "tv" if flat else "l1", iterations=ITERATIONS, time_s=left_s
            )

        def scored(result: Reconstruction) -> Point:
            psnr_db, likeness, nrmse = self.judged(result.volume.sum(axis=0), scene)
            return Point(
                setting.name,
                len(result.histories[0]),
                spent_s + result.seconds,
                psnr_db=psnr_db,
                ssim=likeness,
                nrmse=nrmse,
                images=setting.images,
                family=setting.family,
                group=scene.name,
            )

        return reconstructed, scored

    def warm_up(self, setting: CalibrationSetting) -> None:
        """Reconstruct a small scene of the same sort."""
        grid = 3 if setting.slides else min(setting.grid, 3)
        scene = make_scene("beads", size=24, grid=grid, depths=min(setting.depths, 3))
        for prior in ("tv", "l1"):
            _reconstructed(scene.measurement, scene.calibration, setting, prior, iterations=2)

    def _identity(self) -> Iterator[str | Array]:
        p = self.photographs
        yield f"{p.z_um} {p.geometry} {p.window_px} {p.reach}"
        yield from (p.psfs, p.places, p.slides)
        yield from (image for scene in p.scenes for image in (scene.image, scene.truth))

    def judged(self, found: Array, scene: Photographed) -> tuple[float, float, float]:
        """Return PSNR in dB, SSIM and NRMSE where the scene is, at the best gain and shift."""
        sides = [round(1.1 * self.photographs.reach * n) for n in found.shape]
        seen = tuple(slice((n - s) // 2, (n - s) // 2 + s) for n, s in zip(found.shape, sides, strict=True))
        blurred = _smooth if scene.name != "flat picture" else lambda image: image
        image = blurred(np.asarray(found, np.float64))
        by = displacement(image, blurred(coarse(scene.truth, 0, 0)))
        best = (np.inf, image, image)
        for rows in range(-_SEARCH, _SEARCH + 1):
            for columns in range(-_SEARCH, _SEARCH + 1):
                truth = blurred(coarse(scene.truth, FINE * by[0] + rows, FINE * by[1] + columns))
                energy = float((image[seen] ** 2).sum())
                gain = float((image[seen] * truth[seen]).sum()) / energy if energy > 0 else 0.0
                error = float(np.sqrt(np.mean((gain * image[seen] - truth[seen]) ** 2)))
                if error < best[0]:
                    best = (error, gain * image[seen], truth[seen])
        error, image, truth = best
        white = float(truth.max())
        return (
            float(20 * np.log10(white / max(error, 1e-9 * white))),  # the same: 180 dB
            ssim(image, truth, data_range=white),
            float(error / np.sqrt(np.mean(truth**2))),
        )

    # Calibrations --------------------------------------------------------------------------------
    def _calibrated(self, setting: CalibrationSetting, until: float | None) -> Calibration:
        p = self.photographs
        if setting.slides:
            return self._blind(setting.slides, until)
        side = self._grid()
        along = np.unique(np.round(p.places[:, 0], 6))
        chosen = along[:: (side - 1) // (setting.grid - 1)] if setting.grid > 1 else np.zeros(1)
        psfs, places = [], []
        for z_um in _every(self._depths_um(), setting.depths, p.z_um):
            for row in chosen:
                for column in chosen:
                    taken = self._at(row, column, z_um)[: setting.averaged]
                    psfs.append(self._windowed(p.psfs[taken].mean(axis=0), row, column, z_um))
                    places.append((row, column, z_um))
        return self._calibration(np.stack(psfs), np.array(places))

    def _blind(self, slides: int, until: float | None) -> Calibration:
        p = self.photographs

        def tell(_what: str, _share: float) -> None:
            if until is not None and time.perf_counter() > until:
                raise _OutOfTime

        window = (p.window_px, p.window_px)
        settings = replace(BLIND, reach=p.reach)
        found = calibrate_from_beads(p.slides[:slides], window, settings, on_progress=tell)
        places = np.column_stack([found.points, np.full(len(found.points), p.z_um)])
        return self._calibration(found.on_sensor(), places)

    def _calibration(self, psfs: Float32Array, places: Float64Array) -> Calibration:
        """Give every PSF the light of its distance; places are rows, columns and depths."""
        p = self.photographs
        pitch, distance = p.geometry.pixel_pitch_um, p.geometry.diffuser_distance_mm
        if pitch is None or distance is None:
            raise InputError("Calibrations on a grid need the pixel pitch and the diffuser's distance.")
        light = psfs.sum(axis=(1, 2)) * (places[:, 2] / p.z_um) ** 2
        if not np.all(light > 0):
            row, column, z_um = places[np.argmin(light)]
            raise InputError(
                f"The PSF photographed from row {row:.0f}, column {column:.0f} at {z_um:.0f} um shows no "
                "light above its noise: it cannot be calibrated with."
            )
        object_um = pitch * places[:, 2] / (1e3 * distance)
        positions = np.column_stack([-places[:, 1] * object_um, -places[:, 0] * object_um, places[:, 2]])
        return Calibration(
            np.ascontiguousarray((psfs / light[:, None, None])[:, None], np.float32),
            positions,
            geometry=p.geometry,
        )

    def _windowed(self, psf: Float32Array, row: float, column: float, z_um: float) -> Float32Array:
        """Cut a PSF to its window, and to where it has light above its noise."""
        p = self.photographs
        distance_um = 1e3 * (p.geometry.diffuser_distance_mm or 0.0)
        side = round(p.window_px * (1 + distance_um / z_um) / (1 + distance_um / p.z_um)) // 2 * 2 + 1
        result = np.zeros_like(psf)
        corner = [n // 2 - side // 2 + round(at) for n, at in zip(psf.shape, (row, column), strict=True)]
        kept = tuple(slice(max(c, 0), c + side) for c in corner)
        result[kept] = (psf * support_of(psf))[kept]
        return result

    def _flat(self, calibration: Calibration) -> Calibration:
        """Return the part of a calibration that is of the flat picture's depth."""
        away = np.abs(1 / calibration.source_positions_um[:, 2] - 1 / self.photographs.z_um)
        return calibration.part(away <= away.min() + 1e-9)

    def _at(self, row: float, column: float, z_um: float) -> npt.NDArray[np.int_]:
        return np.flatnonzero(np.all(np.abs(self.photographs.places - (row, column, z_um)) < 1e-6, axis=1))

    def _depths_um(self) -> Float64Array:
        return np.unique(self.photographs.places[:, 2])

    def _grid(self) -> int:
        return len(np.unique(np.round(self.photographs.places[:, 0], 6)))


def _reconstructed(
    image: Array, calibration: Calibration, setting: CalibrationSetting, prior: str, **limits: Any
) -> Reconstruction:
    model = "local" if setting.grid > 1 or setting.slides else "convolution"
    return reconstruct(
        image, calibration, model=model, prior=prior, estimate_background=False, judged=False, **limits
    )


class _OutOfTime(Exception):  # noqa: N818 (no error: the time limit of a blind calibration)
    pass


def coarse(truth: Float32Array, rows: int, columns: int) -> Float64Array:
    """Return a truth in the measurement's pixels, moved by so many of its own."""
    height, width = (n // FINE for n in truth.shape)
    # The pixel on the axis is the middle of FINE.
    first = [
        (FINE * n) // 2 - FINE // 2 - FINE * (n // 2) - by
        for n, by in zip((height, width), (rows, columns), strict=True)
    ]
    fine = np.roll(truth, (-first[0], -first[1]), (0, 1)).astype(np.float64)
    return np.asarray(fine.reshape(height, FINE, width, FINE).sum(axis=(1, 3)))


def _smooth(image: Array) -> Array:
    """Blur by a pixel: a bead is a point, and between two pixels as right as in one of them."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(image, 1.0))


def _every(values: Float64Array, count: int, middle: float) -> Float64Array:
    return np.array([middle]) if count == 1 else values[:: (len(values) - 1) // (count - 1)]
