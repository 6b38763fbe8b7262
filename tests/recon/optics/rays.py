"""Caustics by tracing rays: Snell's law at the relief, straight lines to the sensor, light counted by pixels.

Without diffraction, and without the thin-element and paraxial steps of :mod:`recon.optics.wave`: an
independent check on it, and quicker where a caustic needs no fringes. The diffuser's flat side faces the
source.
"""

from __future__ import annotations

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.optics.diffuser import Diffuser
from recon.optics.grid import PixelGrid, Spectrum
from recon.optics.jit import compiled
from recon.optics.wave import Emission, Source, WavePropagator, check_source


class RayPropagator(WavePropagator):
    """Caustics of geometrical optics.

    Parameters
    ----------
    diffuser, distance_um
        As for :class:`WavePropagator`.
    rays_per_sample : int
        Rays along each side of a sample of the height map.
    """

    def __init__(self, diffuser: Diffuser, distance_um: float, *, rays_per_sample: int = 3) -> None:
        super().__init__(diffuser, distance_um)
        self.rays_per_sample = rays_per_sample
        self._slopes = diffuser.slopes()

    def psf(
        self,
        source_um: Source,
        grid: PixelGrid,
        spectrum: Spectrum,
        *,
        diameter_um: float = 0.0,
        emission: Emission = "lambertian",
    ) -> Float32Array:
        """Light of a point source on the pixels of a sensor grid."""
        check_source(source_um)
        light = np.zeros(grid.shape)
        height, width = grid.shape
        for wavelength_nm, weight in spectrum:
            _trace(
                light,
                grid.center_um[1] - height / 2 * grid.pitch_um,
                grid.center_um[0] - width / 2 * grid.pitch_um,
                grid.pitch_um,
                self._slopes[0],
                self._slopes[1],
                self.diffuser.pitch_um,
                self.diffuser.aperture_um[0],
                self.diffuser.aperture_um[1],
                source_um,
                self.distance_um,
                diameter_um,
                self.diffuser.glass.at(wavelength_nm),
                self.diffuser.ambient.at(wavelength_nm),
                self.rays_per_sample,
                weight,
                emission == "lambertian",
            )
        return light.astype(np.float32)


@compiled
def _trace(  # noqa: PLR0913 - compiled
    light: Float64Array,
    top: float,
    left: float,
    pixel: float,
    slopes_y: Float32Array,
    slopes_x: Float32Array,
    pitch: float,
    aperture_y: float,
    aperture_x: float,
    source: tuple[float, float, float],
    distance: float,
    diameter: float,
    glass: float,
    ambient: float,
    rays: int,
    weight: float,
    lambertian: bool,
) -> None:
    n_rows, n_columns = slopes_y.shape
    step = pitch / rays
    golden = 2.399963229728653
    ray = 0
    for i in range(n_rows * rays):
        y = (i + 0.5) * step - n_rows / 2 * pitch
        if abs(y) > aperture_y / 2:
            continue
        # The slopes are linear between the centres of the samples.
        row = min(max(y / pitch + (n_rows - 1) / 2, 0.0), n_rows - 1.000001)
        r = int(row)
        v = row - r
        for j in range(n_columns * rays):
            x = (j + 0.5) * step - n_columns / 2 * pitch
            if abs(x) > aperture_x / 2:
                continue
            column = min(max(x / pitch + (n_columns - 1) / 2, 0.0), n_columns - 1.000001)
            c = int(column)
            u = column - c
            slope_y = (1 - v) * ((1 - u) * slopes_y[r, c] + u * slopes_y[r, c + 1]) + v * (
                (1 - u) * slopes_y[r + 1, c] + u * slopes_y[r + 1, c + 1]
            )
            slope_x = (1 - v) * ((1 - u) * slopes_x[r, c] + u * slopes_x[r, c + 1]) + v * (
                (1 - u) * slopes_x[r + 1, c] + u * slopes_x[r + 1, c + 1]
            )
            start_x, start_y = source[0], source[1]
            if diameter > 0:
                # A sunflower's pattern covers the disc evenly.
                ray += 1
                fraction = (ray * 0.6180339887498949) % 1.0
                radius = diameter / 2 * np.sqrt(fraction)
                start_x += radius * np.cos(golden * ray)
                start_y += radius * np.sin(golden * ray)
            dx, dy = x - start_x, y - start_y
            square = dx * dx + dy * dy + source[2] * source[2]
            length = np.sqrt(square)
            cos_source = source[2] / length
            # Transverse components of the direction times the index: kept by every flat surface.
            p_x, p_y = dx / length, dy / length
            norm = 1 / np.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
            inside_z = np.sqrt(glass * glass - p_x * p_x - p_y * p_y)
            along = (inside_z - p_x * slope_x - p_y * slope_y) * norm
            outside = ambient * ambient - glass * glass + along * along
            if outside < 0:
                continue  # totally reflected
            change = (np.sqrt(outside) - along) * norm
            q_x, q_y = p_x - change * slope_x, p_y - change * slope_y
            q_square = q_x * q_x + q_y * q_y
            if q_square >= 1:
                continue
            reach = distance / np.sqrt(1 - q_square)
            pixel_row = int(np.floor((y + reach * q_y - top) / pixel))
            pixel_column = int(np.floor((x + reach * q_x - left) / pixel))
            if 0 <= pixel_row < light.shape[0] and 0 <= pixel_column < light.shape[1]:
                share = weight * step * step * cos_source / square
                if lambertian:
                    share *= cos_source
                light[pixel_row, pixel_column] += share
