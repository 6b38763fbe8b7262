"""The mask's pose relative to the SLM's image: parameters, displacement field, and what a wrong one costs."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields, replace

import numpy as np

from recon.arrays import Array, Float64Array
from recon.base.metrics import psnr
from recon.holography.display import Display
from recon.holography.model import HologramModel
from recon.holography.optimise import compute_hologram
from recon.holography.scores import low_pass
from recon.holography.target import Target, make_band


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the mask is relative to the SLM's image.

    The mask cell at ``X`` (mask pixels from the centre) sees the SLM's image at::

        (1 + scale) R(roll) X + shift + cubic (|X|^2 - c) X,   z + yaw x + pitch y downstream of it

    where ``c`` makes the cubic term orthogonal to ``scale`` over the mask.

    Attributes
    ----------
    shift_x, shift_y : float
        Mask pixels.
    roll_mrad, scale : float
        Rotation about the axis; relay magnification less one.
    cubic : float
        Third-order radial distortion: ``cubic |X|^3`` at the mask's corners, mask pixels.
    z_um, pitch_mrad, yaw_mrad : float
        Distance on the axis; tilts about x and y.
    """

    shift_x: float = 0.0
    shift_y: float = 0.0
    roll_mrad: float = 0.0
    scale: float = 0.0
    cubic: float = 0.0
    z_um: float = 0.0
    pitch_mrad: float = 0.0
    yaw_mrad: float = 0.0

    def vector(self) -> Float64Array:
        """Return the parameters as a vector, in the order of :data:`NAMES`."""
        return np.array(astuple(self))

    def plus(self, change: Float64Array) -> Pose:
        """Return the pose with a vector of changes added."""
        return Pose(*(float(v) for v in self.vector() + change))

    def with_(self, **values: float) -> Pose:
        """Return the pose with some parameters replaced."""
        return replace(self, **values)

    def displacement(self, mask_shape: tuple[int, int]) -> Float64Array:
        """Return the displacement field for :class:`recon.holography.Display`.

        It is (*NODES, 2), in mask pixels.
        """
        height, width = mask_shape
        y, x = nodes_of(mask_shape)
        c, s = np.cos(self.roll_mrad * 1e-3), np.sin(self.roll_mrad * 1e-3)
        corner = 0.5 * np.hypot(height, width)
        r2 = x**2 + y**2
        radial = self.cubic * (r2 - (r2**2).mean() / r2.mean()) / corner**3
        sx = (1 + self.scale) * (c * x - s * y) + self.shift_x + radial * x
        sy = (1 + self.scale) * (s * x + c * y) + self.shift_y + radial * y
        return np.stack([sy - y, sx - x], axis=-1)


NODES = (13, 23)
"""Of displacement fields, from edge to edge of the mask; they hold a third-order field to a few per mille."""


def nodes_of(
    mask_shape: tuple[int, int], count: tuple[int, int] = NODES
) -> tuple[Float64Array, Float64Array]:
    """Return y and x of the nodes of displacement fields, mask pixels from the centre."""
    y, x = ((np.linspace(0, 1, n) - 0.5) * size for n, size in zip(count, mask_shape, strict=True))
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    return grid_y, grid_x


NAMES = tuple(field.name for field in fields(Pose))


def natural_steps(mask_shape: tuple[int, int], factor: int, pitch_um: float, depth_um: float) -> Float64Array:
    """Return changes of each parameter that cost a spot a third to a half of its light.

    Parameters
    ----------
    mask_shape : (int, int)
    factor : int
        Mask pixels per SLM pixel: a spot is lost when the mask is off by this much.
    pitch_um : float
        Of the mask's pixels.
    depth_um : float
        Distance at which an SLM pattern has lost half of a spot (:func:`recon.holography.spots.depth_um`).
    """
    half_y, half_x = 0.5 * mask_shape[0], 0.5 * mask_shape[1]
    move, edge, depth = 0.4 * factor, 0.7 * factor, 0.7 * depth_um
    tilts = [1e3 * depth / (half * pitch_um) for half in (half_y, half_x)]
    return np.array([move, move, 1e3 * edge / half_x, edge / half_x, 4.0 * factor, depth, *tilts])


class PlacedHologram:
    """A hologram computed for a mask at one place, seen through it at another.

    The hologram's model knows a displacement field only. What it does not know (distance, tilts, the error of
    the displacement) is propagated here plainly, on the mask's grid.

    Parameters
    ----------
    display : Display
        Its displacement is not used.
    target : Target
        In focus.
    pose : Pose
        Distance and tilts are not known to the hologram.
    rest : ndarray, (rows, columns, 2), or None
        Displacement beyond the pose's, see :class:`recon.holography.spots.SpotMaker`.
    iterations : int
    """

    def __init__(
        self,
        display: Display,
        target: Target,
        pose: Pose,
        rest: Float64Array | None = None,
        *,
        iterations: int = 30,
    ) -> None:
        self.display = display
        self.pose = pose
        self.displacement = pose.displacement(display.mask.shape)
        if rest is not None:
            self.displacement += rest
        placed = replace(display, displacement=self.displacement)
        model = HologramModel(placed, [target])
        self.slm = compute_hologram(model, iterations=iterations).slm[0]
        self._wanted = np.fft.ifftshift(np.asarray(model.wanted(), float))
        self._peak = model.peaks[0]

    def psnr_db(self, pose: Pose, error: Float64Array | None = None) -> float:
        """Return the PSNR seen where the mask is at ``pose``.

        Parameters
        ----------
        pose : Pose
        error : ndarray, (rows, columns, 2), optional
            Displacement to add to what the hologram was computed for, beyond the difference of the poses.
        """
        shape = self.display.mask.shape
        moved = self.displacement + pose.displacement(shape) - self.pose.displacement(shape)
        if error is not None:
            moved = moved + error
        image = _seen(self.slm, self.display, moved, pose)
        scaled = image * (self._wanted.mean() / image.mean())
        return psnr(scaled, self._wanted, data_range=self._peak)


def _seen(slm: Array, display: Display, displacement: Array, pose: Pose) -> Array:
    """Return the low-passed image, FFT order, on the smallest grid that holds it."""
    import scipy.fft  # costs what only who aligns has to wait

    pattern = (slm * display.dc.modulated + display.dc.amplitude).astype(np.complex64)
    field = on_mask(pattern, display, displacement)
    field = propagated(field, display, pose) * display.mask.field(display.wavelength_nm).astype(np.complex64)
    band = make_band(display.slm_shape, display.factor, "alias-free")
    far = scipy.fft.fft2(field, band.shape)
    ey, ex = display.envelope(band.shape)
    image = (far.real**2 + far.imag**2) * (ey[:, None] * ex)
    lags = scipy.fft.rfft2(image)
    rows, columns = band.seen_shape
    small = np.zeros((rows, columns // 2 + 1), lags.dtype)
    top, below, right = band.top, band.kept[0] - band.top, band.kept[1]
    small[:top, :right] = lags[:top, :right]
    small[rows - below :, :right] = lags[lags.shape[0] - below :, :right]
    return low_pass(scipy.fft.irfft2(small, (rows, columns)), display.slm_shape)


def on_mask(pattern: Array, display: Display, displacement: Array) -> Array:
    """Return the SLM's image in the displaced mask's frame, as the model fills it, complex64."""
    from recon.holography import _kernels  # costs what only who aligns has to wait

    height, width = display.mask.shape
    field = np.zeros((height, width), np.complex64)
    # Through a mask that does nothing.
    _kernels.fill_displaced(
        field,
        pattern,
        np.zeros((height, width), np.uint8),
        np.ones(1, np.complex64),
        np.ones(height, np.complex64),
        np.ones(width, np.complex64),
        displacement.astype(np.float32),
        display.factor,
        0,
        height,
    )
    return field


def propagated(field: Array, display: Display, pose: Pose) -> Array:
    """Return light taken from the SLM's image to the tilted mask (first order in the tilt's small depth)."""
    import scipy.fft  # costs what only who aligns has to wait

    if not (pose.z_um or pose.pitch_mrad or pose.yaw_mrad):
        return field
    pitch_mm = display.mask_pitch_um * 1e-3
    fy2, fx2 = (
        np.pi * display.wavelength_nm * 1e-6 * scipy.fft.fftfreq(n, pitch_mm) ** 2 for n in field.shape
    )
    down, across = (np.exp(-1e-3j * pose.z_um * f2).astype(np.complex64) for f2 in (fy2, fx2))
    spectrum = scipy.fft.fft2(field)
    spectrum *= down[:, None]
    spectrum *= across
    there = scipy.fft.ifft2(spectrum)
    if pose.pitch_mrad or pose.yaw_mrad:
        y, x = ((np.arange(n) - (n - 1) / 2) * pitch_mm for n in field.shape)
        depth_mm = (1e-3 * (pose.pitch_mrad * y[:, None] + pose.yaw_mrad * x)).astype(np.float32)
        f2 = (fy2[:, None] + fx2).astype(np.float32)
        there = there + depth_mm * scipy.fft.ifft2(spectrum * (np.complex64(-1j) * f2))
    return np.asarray(there)
