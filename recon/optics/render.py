"""What a scene throws onto the sensor, with the optics' true field dependence.

Beads get a point spread function each, computed at their own place. A picture is cut into cells: what one
pixel looks at, where the picture's own pixels are no finer, else half of that in either direction. The point
spread function of a cell is interpolated linearly between wave-optical ones on a grid of nodes in the field,
after registration to their straight rays.
Nodes lie as densely as the optics demand, which tests hold against point spread functions computed at every
place. The sums run as one linear convolution per node over the cells in its neighbourhood.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.base.fft import fast_shape, irfft_strip, multiply, rfft_strip, spectrum_shape
from recon.base.threads import get_threads, one_of_several
from recon.optics.fall_off import FallOff, response_on
from recon.optics.grid import FloatArray, PixelGrid, mixed_spectrum
from recon.optics.scene import Layer, Scene
from recon.optics.wave import WavePropagator

Weights = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """How finely a scene is rendered."""

    oversampling: int | None = None
    """Cells of a picture along each pixel of the sensor, 1 or more; None: 1 or 2, as the picture needs."""
    node_tolerance: float = 1.0
    """Pixels by which the light's displacement by the relief may differ between neighbouring nodes."""
    widest_spacing: float = 0.2
    """Largest difference between neighbouring nodes in the tangent of the angle of view."""
    fall_off_tolerance: float = 0.06
    """Error of the pixels' angular response by interpolation between nodes."""
    most_nodes: int = 150
    """Where the tolerance asks for more nodes, they are spread more thinly."""
    spectral_samples: int = 1


def render(
    scene: Scene,
    weights: Weights,
    grid: PixelGrid,
    propagator: WavePropagator,
    fall_off: FallOff,
    *,
    layer_photons: float,
    bead_photons: float,
    settings: RenderSettings | None = None,
) -> Float32Array:
    """Photons a second on every pixel of a sensor.

    Parameters
    ----------
    scene : Scene
    weights : tuple of float
        Sensitivity to red, green and blue.
    grid : PixelGrid
        The sensor's pixels.
    propagator, fall_off
        The optics.
    layer_photons : float
        Photons a second from a square millimetre of radiance 1 into a steradian along the axis.
    bead_photons : float
        Photons a second from a bead of power 1 into a steradian.

    Returns
    -------
    ndarray, float32, ``grid.shape``
    """
    settings = settings or RenderSettings()
    image = np.zeros(grid.shape, np.float32)
    for layer in scene.layers:
        image += np.float32(layer_photons) * _render_layer(
            layer, weights, grid, propagator, fall_off, settings
        )
    # Transforms leave rounding errors around zero where it is dark.
    np.maximum(image, 0, out=image)

    def bead(point: tuple[FloatArray, FloatArray, float]) -> Float32Array | None:
        place, power, diameter = point
        source = (float(place[0]), float(place[1]), float(place[2]))
        spectrum = mixed_spectrum(product(weights, power), settings.spectral_samples)
        if not spectrum:
            return None
        light = propagator.psf(source, grid, spectrum, diameter_um=diameter, emission="isotropic")
        light *= response_on(grid, source, propagator.distance_um, fall_off)
        return light

    with ThreadPoolExecutor(get_threads(), "render", one_of_several) as pool:
        for light in pool.map(bead, scene.points()):
            if light is not None:
                image += np.float32(bead_photons) * light
    return image


def product(weights: Weights, power: Sequence[float] | Float64Array) -> Weights:
    """Return sensitivities to red, green and blue times the power in each."""
    red, green, blue = (w * float(p) for w, p in zip(weights, power, strict=True))
    return red, green, blue


def _render_layer(
    layer: Layer,
    weights: Weights,
    grid: PixelGrid,
    propagator: WavePropagator,
    fall_off: FallOff,
    settings: RenderSettings,
) -> Float32Array:
    """Sum over bands; one pass suffices where the picture is grey, as then only brightness varies."""
    red, green, blue = np.moveaxis(layer.radiance, 2, 0)
    if np.array_equal(red, green) and np.array_equal(green, blue):
        passes = [((1.0, 0.0, 0.0), weights)]
    else:
        passes = []
        for band in range(3):
            pick = (float(band == 0), float(band == 1), float(band == 2))
            passes.append((pick, product(weights, pick)))
    total = np.zeros(grid.shape, np.float32)
    for pick, spectral_weights in passes:
        if any(spectral_weights):
            renderer = _LayerRenderer(layer, pick, spectral_weights, grid, propagator, fall_off, settings)
            total += renderer.render()
    return total


class _LayerRenderer:
    """One picture in one spectrum. Lengths on the sensor; a cell at ``t`` looks at ``x = -t z / d``."""

    def __init__(
        self,
        layer: Layer,
        pick: Weights,
        spectral_weights: Weights,
        grid: PixelGrid,
        propagator: WavePropagator,
        fall_off: FallOff,
        settings: RenderSettings,
    ) -> None:
        self.layer = layer
        self.propagator = propagator
        self.fall_off = fall_off
        self.settings = settings
        self.spectrum = mixed_spectrum(spectral_weights, settings.spectral_samples)
        self.magnification = propagator.distance_um / layer.z_um
        self.oversampling = settings.oversampling or (2 if _finer(layer, grid, self.magnification) else 1)
        self.fine = grid.refined(self.oversampling)
        self.half_kernel = propagator.half_extent_um(layer.z_um)
        self.cells_y = self._cells(0, layer.y_edges_um)
        self.cells_x = self._cells(1, layer.x_edges_um)
        self.flux = self._flux(pick)

    def render(self) -> Float32Array:
        image = np.zeros(self.fine.shape, np.float32)
        if self.flux.any():
            nodes_y, nodes_x = self._nodes()
            self.flux *= self._vignetting_ratio(nodes_y, nodes_x)
            indices = itertools.product(range(len(nodes_y)), range(len(nodes_x)))
            with ThreadPoolExecutor(get_threads(), "render", one_of_several) as pool:
                # Added up in their order, whoever is done first: the sum is the same to the last bit.
                for part in pool.map(lambda at: self._node(nodes_y, at[0], nodes_x, at[1]), indices):
                    if part is not None:
                        _add_clipped(image, *part)
        factor = self.oversampling
        height, width = self.fine.shape
        tiles = image.reshape(height // factor, factor, width // factor, factor)
        return np.asarray(tiles.sum(axis=(1, 3)), np.float32)

    def _cells(self, axis: int, edges_um: Float64Array) -> range:
        """Cells (multiples of the fine pitch) that hold any of the picture and can reach the sensor."""
        pitch = self.fine.pitch_um
        center = self.fine.center_um[1 - axis]
        on_sensor = (-edges_um[[-1, 0]] * self.magnification - center) / pitch
        reach = (self.fine.shape[axis] * pitch / 2 + self.half_kernel[axis]) / pitch
        low = max(int(np.floor(on_sensor[0] + 0.5)), -int(np.ceil(reach)))
        high = min(int(np.ceil(on_sensor[1] - 0.5)), int(np.ceil(reach)))
        return range(low, max(low, high) + 1)

    def _flux(self, pick: Weights) -> Float32Array:
        """Radiance times area in every cell."""
        pitch = self.fine.pitch_um
        borders = []
        for cells, center in ((self.cells_y, self.fine.center_um[1]), (self.cells_x, self.fine.center_um[0])):
            on_sensor = center + (np.arange(cells.start, cells.stop + 1) - 0.5) * pitch
            borders.append(np.asarray(-on_sensor[::-1] / self.magnification, np.float64))
        return np.ascontiguousarray(self.layer.flux(pick, borders[0], borders[1])[::-1, ::-1])

    def _nodes(self) -> tuple[Float64Array, Float64Array]:
        """Node positions along y and x, in cells."""
        settings, distance_um = self.settings, self.propagator.distance_um
        pitch = self.fine.pitch_um
        # Off axis the way to the sensor grows by (1 + t^2)^(3/2), and with it what the relief displaces.
        stretch = 3.3 * self.propagator.displacement_um(self.layer.z_um)
        tolerance = settings.node_tolerance * pitch * self.oversampling / stretch
        widest = min(settings.widest_spacing, _fall_off_spacing(self.fall_off, settings.fall_off_tolerance))
        while True:
            spans = [
                (cells.start * pitch / distance_um, (cells.stop - 1) * pitch / distance_um)
                for cells in (self.cells_y, self.cells_x)
            ]
            along_y, along_x = (_nodes_between(*span, tolerance, widest) for span in spans)
            if len(along_y) * len(along_x) <= settings.most_nodes:
                return along_y * distance_um / pitch, along_x * distance_um / pitch
            tolerance *= 1.2
            widest *= 1.1

    def _vignetting_ratio(self, nodes_y: Float64Array, nodes_x: Float64Array) -> Float32Array:
        """Return the light collected from every cell over what the nodes, interpolated, make of it."""

        def collected(t_y: Float64Array, t_x: Float64Array) -> Float64Array:
            to_tangent = self.fine.pitch_um / self.propagator.distance_um
            tan_y, tan_x = t_y[:, None] * to_tangent, t_x * to_tangent
            return np.asarray(self.fall_off(tan_y, tan_x) / (1 + tan_y**2 + tan_x**2) ** 2)

        cells_y = np.arange(self.cells_y.start, self.cells_y.stop, dtype=np.float64)
        cells_x = np.arange(self.cells_x.start, self.cells_x.stop, dtype=np.float64)
        at_nodes = collected(nodes_y, nodes_x)
        along_x = np.stack([np.interp(cells_x, nodes_x, row) for row in at_nodes])
        interpolated = np.stack([np.interp(cells_y, nodes_y, column) for column in along_x.T], axis=1)
        exact = collected(cells_y, cells_x)
        return np.asarray(
            np.where(interpolated > 1e-6, exact / np.maximum(interpolated, 1e-6), 1.0), np.float32
        )

    def _node(
        self, nodes_y: Float64Array, j: int, nodes_x: Float64Array, i: int
    ) -> tuple[Float32Array, int, int] | None:
        """Return the light of the cells around a node, and where it lies on the fine pixels."""
        weight_y, first_y = _hat(nodes_y, j, self.cells_y)
        weight_x, first_x = _hat(nodes_x, i, self.cells_x)
        rows = slice(first_y - self.cells_y.start, first_y - self.cells_y.start + len(weight_y))
        columns = slice(first_x - self.cells_x.start, first_x - self.cells_x.start + len(weight_x))
        patch = self.flux[rows, columns] * weight_y[:, None] * weight_x
        if not patch.any():
            return None
        kernel = self._kernel(nodes_y[j], nodes_x[i])
        used = tuple(a + b - 1 for a, b in zip(patch.shape, kernel.shape, strict=True))
        shape = fast_shape(used)
        light = np.zeros(shape, np.float32)
        spectra = []
        for part in (kernel, patch):
            strip = light[: part.shape[0]]
            strip[:, : part.shape[1]] = part
            spectra.append(rfft_strip(strip[None], 0, np.empty((1, *spectrum_shape(shape)), np.complex64)))
            strip[...] = 0
        multiply(*spectra)
        irfft_strip(spectra[0], 0, light[None, : used[0]])
        light = light[: used[0], : used[1]]
        # Kernel pixel k lies at (k - (n - 1) / 2) from the straight ray, fine pixel p at (p - (N - 1) / 2)
        # from the centre: n and N are both even or both odd.
        top = first_y + (self.fine.shape[0] - kernel.shape[0]) // 2
        left = first_x + (self.fine.shape[1] - kernel.shape[1]) // 2
        return light, top, left

    def _kernel(self, node_y: float, node_x: float) -> Float32Array:
        """Point spread function of a node on fine pixels about its straight ray."""
        pitch = self.fine.pitch_um
        center = (self.fine.center_um[0] + node_x * pitch, self.fine.center_um[1] + node_y * pitch)
        z = self.layer.z_um
        source = (-center[0] / self.magnification, -center[1] / self.magnification, z)
        shape = []
        extent = self.propagator.half_extent_um(z, float(np.hypot(*source[:2])) / z)
        for side, half in zip(self.fine.shape, extent, strict=True):
            count = 2 * int(np.ceil(half / pitch))
            shape.append(count + side % 2)
        grid = PixelGrid((shape[0], shape[1]), pitch, center)
        kernel = self.propagator.psf(source, grid, self.spectrum, cell=self.oversampling == 1)
        kernel *= response_on(grid, source, self.propagator.distance_um, self.fall_off)
        return kernel


def _finer(layer: Layer, grid: PixelGrid, magnification: float) -> bool:
    """Whether a picture's pixels, or all of it, are smaller than what one pixel of the sensor looks at."""
    sides = zip(layer.size_um, layer.radiance.shape[:2], strict=True)
    return any(size / count * magnification < grid.pitch_um for size, count in sides)


def _fall_off_spacing(fall_off: FallOff, tolerance: float) -> float:
    """Spacing, in tangents, at which linear interpolation of the response errs by the tolerance."""
    step = 0.05
    tangents: Float64Array = np.linspace(-20 * step, 20 * step, 41)
    curvature = 0.0
    for response in (fall_off(tangents, np.zeros(1)), fall_off(np.zeros(1), tangents)):
        curvature = max(curvature, float(np.abs(np.diff(response, 2)).max()) / step**2)
    return float(np.sqrt(8 * tolerance / max(curvature, 1e-9)))


def _nodes_between(low: float, high: float, tolerance: float, widest: float) -> Float64Array:
    """Positions from ``low`` to ``high``, the steps between them inverse to the distance from the axis."""
    if high - low < 1e-9:
        return np.array([(low + high) / 2])
    if low < 0 < high:
        downwards = _march(-low, tolerance, widest, 0.0)
        return np.concatenate([-downwards[:0:-1], _march(high, tolerance, widest, 0.0)])
    if high <= 0:
        return -_march(-low, tolerance, widest, -high)[::-1]
    return _march(high, tolerance, widest, low)


def _march(end: float, tolerance: float, widest: float, start: float) -> Float64Array:
    """Step outwards from ``start`` until ``end`` is reached: pictures of any size share their nodes."""
    positions = [start]
    while positions[-1] < end:
        positions.append(positions[-1] + min(widest, tolerance / max(positions[-1], 1e-9)))
    return np.asarray(positions)


def _hat(nodes: Float64Array, index: int, cells: range) -> tuple[Float32Array, int]:
    """Weights of linear interpolation for one node, and the first cell they belong to."""
    position = np.arange(cells.start, cells.stop)
    unit = np.zeros(len(nodes))
    unit[index] = 1
    weights = np.interp(position, nodes, unit)
    used = np.flatnonzero(weights)
    if not len(used):
        return np.zeros(1, np.float32), cells.start
    return weights[used[0] : used[-1] + 1].astype(np.float32), cells.start + int(used[0])


def _add_clipped(image: Float32Array, light: Float32Array, top: int, left: int) -> None:
    """Add ``light`` to ``image`` at a place that may stick out."""
    height, width = light.shape
    first_row, first_column = max(0, -top), max(0, -left)
    last_row, last_column = min(height, image.shape[0] - top), min(width, image.shape[1] - left)
    if last_row > first_row and last_column > first_column:
        image[top + first_row : top + last_row, left + first_column : left + last_column] += light[
            first_row:last_row, first_column:last_column
        ]
