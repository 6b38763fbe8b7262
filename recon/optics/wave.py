r"""Caustics by scalar wave optics, for a point source anywhere in front of the diffuser.

The diffuser is a thin element. A spherical wave from the source meets it at the angle :math:`\theta(u)` and
gains the phase

.. math:: k\,h(u)\,\bigl(\sqrt{n^2 - \sin^2\theta} - \sqrt{n_a^2 - \sin^2\theta}\bigr),

the path difference along the refracted and the unrefracted ray. Propagation to the sensor is expanded to
second order about the straight ray through each point. With the source's own curvature taken out (Fresnel
scaling theorem) what remains is a convolution with a quadratic phase over the distance
:math:`\rho = z d / (z + d)`, stretched by :math:`1/\cos\theta` across and :math:`1/\cos^3\theta` along the
direction of incidence, followed by the exact projection :math:`s = (1 + d/z)\,u - (d/z)\,x`. Because
:math:`\theta` differs over the aperture when the source is close, the aperture is worked on in tiles small
enough that the stretch hardly varies within one. docs/decisions/0008-propagation.md compares the choices.
"""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array
from recon.base.fft import fast_length
from recon.base.threads import in_blocks, over_rows
from recon.optics.diffuser import Diffuser
from recon.optics.grid import FloatArray, PixelGrid, Spectrum, resample_energy

ComplexArray = npt.NDArray[np.complex64]
Emission = Literal["lambertian", "isotropic"]
Source = tuple[float, float, float]


def check_source(source_um: Source) -> None:
    """Raise ``ValueError`` unless the source lies at a finite place in front of the diffuser."""
    if not (np.isfinite(source_um).all() and source_um[2] > 0):
        raise ValueError(f"A source lies in front of the diffuser: finite, z_um > 0, not {source_um}.")


# Largest relative error of the stretched distance within one tile. The displacement of light by the relief
# (some tens of micrometres) is wrong by at most this fraction: well below a pixel.
TILE_TOLERANCE = 0.04
MOST_TILES = 256
CELL_POINTS: FloatArray = np.array([-0.375, -0.125, 0.125, 0.375])
"""Places along each side of a square cell, in its sides, whose light is summed for the cell's."""
KEPT_BYTES = 256 << 20
"""Of the newest point spread functions: another picture at the distance of one needs the same."""


@dataclass(frozen=True, slots=True)
class Caustic:
    """Light on the sensor, on the grid of straight rays through the diffuser.

    Attributes
    ----------
    energy : ndarray, float32, (h, w)
        Light in each cell for a source of unit intensity along the axis (steradians).
    y_edges_um, x_edges_um : ndarray, float64
        Borders of the cells on the sensor.
    """

    energy: Float32Array
    y_edges_um: FloatArray
    x_edges_um: FloatArray

    def on(self, grid: PixelGrid, *, cell: bool = False) -> Float32Array:
        """Integrate over the pixels of a sensor grid; ``grid.shape``, float32.

        ``cell``: of the square that one pixel looks at, evenly bright, together as bright as the point.
        """
        shifts = grid.pitch_um * CELL_POINTS if cell else np.zeros(1)
        return resample_energy(
            self.energy, self.y_edges_um, self.x_edges_um, grid.y_edges_um, grid.x_edges_um, shifts
        )


@dataclass(frozen=True, slots=True)
class _Tile:
    """A part of the plane of straight rays: samples ``rows`` x ``columns``, seen under one direction."""

    rows: range
    columns: range
    tan_squared: float
    cos: float
    direction: tuple[float, float]
    """Unit vector ``(y, x)`` of the plane of incidence."""


class WavePropagator:
    """Point spread functions of one diffuser at one distance from the sensor, by diffraction.

    Parameters
    ----------
    diffuser : Diffuser
    distance_um : float
        From the diffuser's relief to the sensor.
    """

    def __init__(self, diffuser: Diffuser, distance_um: float) -> None:
        if not 0 < distance_um < np.inf:
            raise ValueError(f"The sensor lies behind the diffuser: distance_um > 0, not {distance_um}.")
        self.diffuser = diffuser
        self.distance_um = distance_um
        slope = np.hypot(*diffuser.slopes())
        self._typical_slope = float(np.sqrt((slope**2).mean()))
        self._steepest = float(np.quantile(slope, 0.9995))
        self._kept: OrderedDict[Any, Float32Array] = OrderedDict()
        self._lock = threading.Lock()

    def psf(
        self,
        source_um: Source,
        grid: PixelGrid,
        spectrum: Spectrum,
        *,
        diameter_um: float = 0.0,
        emission: Emission = "lambertian",
        cell: bool = False,
    ) -> Float32Array:
        """Light of a point source (or small disc, or square cell) on the pixels of a sensor grid.

        Parameters
        ----------
        source_um : tuple of float
            ``(x, y, z)`` with ``z > 0``, any continuous position.
        grid : PixelGrid
            The sensor's pixels.
        spectrum : Spectrum
            Wavelengths that the source sends out, each with a weight; intensities add up.
        diameter_um : float
            Diameter of a uniformly bright disc parallel to the sensor (0: a point).
        emission : {"lambertian", "isotropic"}
            A pinhole or screen that faces the sensor, or a fluorescent bead.
        cell : bool
            Spread over the square that one pixel looks at.

        Returns
        -------
        ndarray, float32, ``grid.shape``
            Solid angle in steradians that feeds each pixel (times the cosine of emission for a Lambertian
            source): multiplied by the source's intensity along the axis, the light on the pixel. The angular
            response of the pixels is not included (:mod:`recon.optics.fall_off`).
        """
        key = (source_um, grid, spectrum, diameter_um, emission, cell)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key].copy()
        caustic = self.caustic(source_um, grid, spectrum, diameter_um=diameter_um, emission=emission)
        light = caustic.on(grid, cell=cell)
        with self._lock:
            self._kept[key] = light.copy()
            while sum(kept.nbytes for kept in self._kept.values()) > KEPT_BYTES:
                self._kept.popitem(last=False)
        return light

    def displacement_um(self, z_um: float) -> float:
        """Return how far the relief typically displaces light on the sensor (root mean square, on axis)."""
        contrast = self.diffuser.glass.index - self.diffuser.ambient.index
        return self._typical_slope * contrast * self._reduced_distance_um(z_um)

    def half_extent_um(self, z_um: float, angle: float = 0.7) -> tuple[float, float]:
        """Half height and width on the sensor that hold all light of a source at a distance.

        ``angle``: tangent of how far off the axis it is at the most.
        """
        # 35 degrees off the axis; beyond, the little light that strays farther is cut off.
        spread = self._spread_um((min(angle, 0.7) * z_um, 0.0, z_um), 650.0)
        scale = 1 + self.distance_um / z_um
        height, width = self.diffuser.aperture_um
        return (height / 2 + spread) * scale, (width / 2 + spread) * scale

    def _reduced_distance_um(self, z_um: float) -> float:
        """Return ``z d / (z + d)``: the sensor's distance once the source's own curvature is taken out."""
        return self.distance_um / (1 + self.distance_um / z_um)

    def _spread_um(self, source_um: Source, wavelength_nm: float) -> float:
        """Return how far light may leave its straight ray, in the diffuser's plane, at the worst angle."""
        x, y, z = source_um
        half_height, half_width = (side / 2 for side in self.diffuser.aperture_um)
        tangent = np.hypot(abs(x) + half_width, abs(y) + half_height) / z
        cos = 1 / np.sqrt(1 + tangent**2)
        glass, ambient = self.diffuser.glass.at(wavelength_nm), self.diffuser.ambient.at(wavelength_nm)
        contrast = np.sqrt(glass**2 - (1 - cos**2)) - np.sqrt(ambient**2 - (1 - cos**2))
        stretched = self._reduced_distance_um(z) / cos**3
        refracted = self._steepest * abs(contrast) * stretched
        diffracted = 2.5 * np.sqrt(wavelength_nm * 1e-3 * stretched)
        return float(refracted + diffracted)

    def caustic(
        self,
        source_um: Source,
        grid: PixelGrid,
        spectrum: Spectrum,
        *,
        diameter_um: float = 0.0,
        emission: Emission = "lambertian",
    ) -> Caustic:
        """As :meth:`psf`, before integration over pixels; covers at least what falls on the grid."""
        x, y, z = source_um
        check_source(source_um)
        pitch = self.diffuser.pitch_um
        magnification = self.distance_um / z
        scale = 1 + magnification
        rho = self.distance_um / scale
        blur = diameter_um * magnification / scale / pitch
        n_rows, n_columns = self.diffuser.heights_um.shape
        margin = int(np.ceil(self._spread_um(source_um, max(w for w, _ in spectrum)) / pitch))
        reach = margin + int(np.ceil(blur))
        rows = _needed(grid.y_edges_um, n_rows, y, magnification, pitch, reach)
        columns = _needed(grid.x_edges_um, n_columns, x, magnification, pitch, reach)
        energy = np.zeros((len(rows), len(columns)), np.float32)
        for tile in self._tiles(rows, columns, source_um):
            part = energy[_within(tile.rows, rows), _within(tile.columns, columns)]
            self._add_tile(part, tile, source_um, margin, rho, spectrum, emission)
        if blur > 0.5 and energy.size:  # empty: the pattern lies wholly off the sensor
            energy = np.asarray(cv2.filter2D(energy, -1, disc_kernel(blur), borderType=cv2.BORDER_CONSTANT))
        y_edges = (np.arange(rows.start, rows.stop + 1) - n_rows / 2) * pitch * scale - magnification * y
        x_edges = (np.arange(columns.start, columns.stop + 1) - n_columns / 2) * pitch * scale
        return Caustic(energy.astype(np.float32, copy=False), y_edges, x_edges - magnification * x)

    def _tiles(self, rows: range, columns: range, source_um: Source) -> list[_Tile]:
        """Cut the plane of straight rays until the direction of incidence hardly varies within a tile."""
        if not len(rows) or not len(columns):
            return []
        x, y, z = source_um
        n_rows, n_columns = self.diffuser.heights_um.shape
        pitch = self.diffuser.pitch_um

        def tangent_squared(row: float, column: float) -> float:
            dy = y - (row - (n_rows - 1) / 2) * pitch
            dx = x - (column - (n_columns - 1) / 2) * pitch
            return float(dy**2 + dx**2) / z**2

        along_y, along_x = 1, 1
        while True:
            tiles, worst = [], 0.0
            for tile_rows in _split(rows, along_y):
                for tile_columns in _split(columns, along_x):
                    row = (tile_rows.start + tile_rows.stop - 1) / 2
                    column = (tile_columns.start + tile_columns.stop - 1) / 2
                    here = tangent_squared(row, column)
                    for corner_row in (tile_rows.start, tile_rows.stop):
                        for corner_column in (tile_columns.start, tile_columns.stop):
                            there = tangent_squared(corner_row, corner_column)
                            worst = max(worst, abs(((1 + there) / (1 + here)) ** 1.5 - 1))
                    dy = y - (row - (n_rows - 1) / 2) * pitch
                    dx = x - (column - (n_columns - 1) / 2) * pitch
                    length = float(np.hypot(dy, dx)) or 1.0
                    tiles.append(
                        _Tile(tile_rows, tile_columns, here, (1 + here) ** -0.5, (dy / length, dx / length))
                    )
            if worst <= TILE_TOLERANCE or len(tiles) >= MOST_TILES:
                return tiles
            if len(rows) / along_y > len(columns) / along_x:
                along_y += 1
            else:
                along_x += 1

    def _add_tile(
        self,
        energy: Float32Array,
        tile: _Tile,
        source_um: Source,
        margin: int,
        rho_um: float,
        spectrum: Spectrum,
        emission: Emission,
    ) -> None:
        diffuser = self.diffuser
        pitch = diffuser.pitch_um
        n_rows, n_columns = diffuser.heights_um.shape
        along_y = _window(tile.rows, margin, n_rows, pitch, diffuser.aperture_um[0])
        along_x = _window(tile.columns, margin, n_columns, pitch, diffuser.aperture_um[1])
        if along_y is None or along_x is None:
            return
        first_row, row_window, height = along_y
        first_column, column_window, width = along_x
        field = np.zeros((height, width), np.complex64)
        pairs = field.view(np.float32)
        top, left = tile.rows.start - first_row, tile.columns.start - first_column
        wanted = field[top : top + len(tile.rows)]
        inner = wanted[:, left : left + len(tile.columns)].view(np.float32)
        kernels = _kernels()
        for number, (wavelength_nm, weight) in enumerate(spectrum):
            if number:
                field[...] = 0
            wavelength_um = wavelength_nm * 1e-3
            kernels.modulate(
                pairs,
                diffuser.heights_um,
                row_window,
                column_window,
                first_row,
                first_column,
                pitch,
                source_um[0],
                source_um[1],
                source_um[2],
                2 * np.pi / wavelength_um,
                diffuser.glass.at(wavelength_nm) ** 2,
                diffuser.ambient.at(wavelength_nm) ** 2,
                emission == "lambertian",
            )
            over_rows(_transform, field[: len(row_window)], True, 1.0)
            _propagate(field, tile, pitch, np.pi * wavelength_um * rho_um / tile.cos)
            over_rows(_transform, wanted, False, 1 / field.size)
            kernels.add_intensity(energy, inner, weight)


@cache
def _kernels() -> Any:
    """Import transforms on first use: 0.25 s that a scene whose light was kept need not pay."""
    from recon.optics import wave_kernels

    return wave_kernels


def _transform(start: int, stop: int, field: ComplexArray, forward: bool, scale: float) -> None:
    _kernels().transform_rows(field[start:stop], forward, scale)


def _propagate(field: ComplexArray, tile: _Tile, pitch: float, strength: float) -> None:
    """Take a field whose rows are transformed through a distance, columns shared among threads."""
    height, width = field.shape
    rows, columns = np.fft.fftfreq(height, pitch), np.fft.fftfreq(width, pitch)
    kernels = _kernels()
    pairs = field.view(np.float32)

    def some(start: int, stop: int) -> None:
        kernels.propagate(
            field, pairs, start, stop, rows, columns, strength, tile.tan_squared, *tile.direction
        )

    in_blocks(some, -(-width // kernels.COLUMNS))


def disc_kernel(diameter: float) -> Float32Array:
    """Uniform disc of a diameter in samples, area-sampled; sums to 1."""
    half = int(np.ceil(diameter / 2))
    fine = 8
    axis = (np.arange((2 * half + 1) * fine) - ((2 * half + 1) * fine - 1) / 2) / fine
    disc = (np.hypot(axis[:, None], axis) <= diameter / 2).astype(np.float32)
    side = 2 * half + 1
    kernel = disc.reshape(side, fine, side, fine).sum(axis=(1, 3))
    return np.asarray(kernel / kernel.sum(), np.float32)


def _needed(
    sensor_edges: FloatArray, samples: int, position: float, magnification: float, pitch: float, reach: int
) -> range:
    """Return the samples of the plane of straight rays that can receive light and land on the sensor."""
    low, high = (sensor_edges[[0, -1]] + magnification * position) / (1 + magnification) / pitch + samples / 2
    start = max(-reach, int(np.floor(low)) - 1)
    return range(start, max(start, min(samples + reach, int(np.ceil(high)) + 1)))


def _within(part: range, whole: range) -> slice:
    return slice(part.start - whole.start, part.stop - whole.start)


def _split(span: range, parts: int) -> list[range]:
    borders = np.linspace(span.start, span.stop, parts + 1).round().astype(int).tolist()
    return [range(low, high) for low, high in itertools.pairwise(borders) if high > low]


def _window(
    span: range, margin: int, samples: int, pitch: float, aperture_um: float
) -> tuple[int, Float32Array, int] | None:
    """Amplitude along one axis of what lights the samples ``span``: aperture and soft cut.

    Returns
    -------
    first : int
        The sample at which both the amplitudes and the transform begin.
    amplitude : ndarray, float32
    length : int
        Of the transform: light that goes half as far again as ``margin`` comes round only where nothing is
        looked at.

    None where the aperture lets no light through.
    """
    index = np.arange(span.start - margin, span.stop + margin)
    low = (index - samples / 2) * pitch
    covered = np.minimum(low + pitch, aperture_um / 2) - np.maximum(low, -aperture_um / 2)
    amplitude = np.sqrt(np.clip(covered / pitch, 0, 1))
    # Where a tile is cut out of the aperture, fade out instead of adding an edge that is not there.
    fade = max(margin // 2, 1)
    ramp = np.sin(np.pi / 2 * (np.arange(fade) + 0.5) / fade)
    amplitude[:fade] *= ramp
    amplitude[-fade:] *= ramp[::-1]
    lit = index[amplitude > 0]
    if not len(lit):
        return None
    begin, end = int(lit[0]), int(lit[-1]) + 1
    first = min(begin, span.start)
    reach = margin + margin // 2
    length = max(end + reach - span.start, span.stop + reach - begin, span.stop - first, end - first)
    return first, amplitude[first - index[0] : end - index[0]].astype(np.float32), fast_length(length)
