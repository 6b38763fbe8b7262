"""SLM patterns that focus many spots at once, each as if the mask were somewhere else.

A spot is bright only where its hypothesis about the mask is right: the brightest spot of a picture tells the
pose. Nothing has to move. The field that makes a spot is the conjugate mask times a plane wave, propagated
back from the mask to the SLM's image and integrated over SLM pixels (Kuo 2020, Eqs. 7.11 and 7.12 with free
space added). It is computed from the mask's spectrum, of which an SLM pixel passes only the main lobe of its
sinc.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from recon.arrays import Array, Float64Array
from recon.holography.display import Display
from recon.holography.pose import NAMES, Pose, natural_steps


@dataclass(frozen=True, slots=True)
class PoseStep:
    """What one frame (or several) of probe spots say.

    Attributes
    ----------
    change : ndarray, float64, (8,)
        To add to the pose, in its units.
    error : ndarray, float64, (8,)
        Standard uncertainty of the change.
    """

    change: Float64Array
    error: Float64Array


class PoseProbe:
    """Pairs of spots on either side of a pose, one pair a parameter, and what their brightness means.

    For parameter ``p`` two spots assume ``pose + step_p`` and ``pose - step_p``. From their amplitudes ``a+``
    and ``a-`` comes ``g_p = (a+ - a-) / (a+ + a-)``, zero at the right pose. How ``g`` depends on a small
    error in every parameter is computed once, from the fields themselves; errors in all parameters then
    follow from one linear system.
    """

    def __init__(self, maker: SpotMaker) -> None:
        self.maker = maker
        display = maker.display
        self.steps = natural_steps(
            display.mask.shape, display.factor, display.mask_pitch_um, depth_um(display)
        )
        self._jacobian: Float64Array | None = None

    def poses(self, pose: Pose) -> list[Pose]:
        """Return the probe poses: plus and minus for each parameter, then the pose itself."""
        found = []
        for p in range(len(NAMES)):
            change = np.zeros(len(NAMES))
            change[p] = self.steps[p]
            found += [pose.plus(change), pose.plus(-change)]
        return [*found, pose]

    def jacobian(self) -> Float64Array:
        """Return ``dg_p / d(error_q / step_q)``, (8, 8)."""
        if self._jacobian is None:
            n = len(NAMES)
            at = Pose()
            wanted = [np.exp(1j * np.angle(self._field(pose))) for pose in self.poses(at)[:-1]]
            jacobian = np.zeros((n, n))
            small = 0.2
            for q in range(n):
                error = np.zeros(n)
                error[q] = small * self.steps[q]
                sides = []
                for sign in (1, -1):
                    truth = self._field(at.plus(sign * error))
                    a = np.array([abs(np.vdot(truth, slm)) for slm in wanted])
                    sides.append((a[0::2] - a[1::2]) / (a[0::2] + a[1::2]))
                jacobian[:, q] = (sides[0] - sides[1]) / (2 * small)
            self._jacobian = jacobian
        return self._jacobian

    def step(self, brightness: Array, noise: float, pose: Pose, prior: Array) -> PoseStep:
        """Turn measured brightness into a change of pose.

        Parameters
        ----------
        brightness : ndarray, (n_frames, 17)
            Spot intensities in the order of :meth:`poses`; negative ones count as zero.
        noise : float
            Standard deviation of a spot's amplitude from what surrounds it, in the square root of the
            brightness' units.
        pose : Pose
            The pose probed.
        prior : ndarray, (8,)
            Standard deviation of each parameter before anything was measured, about zero; infinite for none.
        """
        amplitude = np.sqrt(np.maximum(brightness, 0))
        plus, minus = amplitude[:, 0:16:2].mean(axis=0), amplitude[:, 1:16:2].mean(axis=0)
        total = np.maximum(plus + minus, 1e-12)
        g = (plus - minus) / total
        sigma = noise / np.sqrt(len(amplitude)) * np.sqrt(2) / total
        if len(amplitude) > 2:
            # Spots differ by more than the speckle around them where something is not modelled.
            single = amplitude[:, 0:16:2] - amplitude[:, 1:16:2]
            scatter = np.sqrt(single.var(axis=0, ddof=1) / len(amplitude)) / total
            sigma *= max(1.0, float(np.sqrt(np.mean((scatter / sigma) ** 2))))
        weighted = self.jacobian() / sigma[:, None]
        likely = (self.steps / prior) ** 2
        # Without the unit term a picture that tells nothing would throw the pose far away.
        covariance = np.linalg.inv(weighted.T @ weighted + np.diag(likely) + np.eye(len(NAMES)))
        change = covariance @ (weighted.T @ (g / sigma) - likely * pose.vector() / self.steps)
        return PoseStep(np.clip(change, -1.2, 1.2) * self.steps, np.sqrt(np.diag(covariance)) * self.steps)

    def _field(self, pose: Pose) -> Array:
        return self.maker.field(Spot(3, 5, pose))


@dataclass(frozen=True, slots=True)
class Spot:
    """A spot to focus.

    Attributes
    ----------
    row, column : int
        Where, in integer bins of the mask's spectrum from the axis.
    pose : Pose
        For which it is bright.
    section : (slice, slice) or None
        Rows and columns of the SLM that make it; all of them by default.
    """

    row: int
    column: int
    pose: Pose
    section: tuple[slice, slice] | None = None


@dataclass(frozen=True, slots=True)
class SpotPattern:
    """A pattern and what it would do.

    Attributes
    ----------
    slm : ndarray, complex64, (height, width)
        Of modulus 1.
    spots : tuple of Spot
    ideal : float
        Intensity of a spot if its pose is the true one, in units of the mean over the field; without DC term
        and envelope.
    """

    slm: npt.NDArray[np.complex64]
    spots: tuple[Spot, ...]
    ideal: float


def depth_um(display: Display) -> float:
    """Return the distance over which a random SLM pattern loses half of a spot's light."""
    return 1.5 * (display.slm_pitch_um * 1e-3) ** 2 / (display.wavelength_nm * 1e-6) * 1e3


FLAT = 0.1
"""A tilt that moves the corners by less than this part of :func:`depth_um` costs a spot less than 1 % of its
light and is not computed."""


class SpotMaker:
    """Computes spot patterns for one display.

    Parameters
    ----------
    display : Display
        Its ``displacement`` is not used: poses say where the mask is.

    Attributes
    ----------
    rest : ndarray, float64, (rows, columns, 2), or None
        Displacement beyond that of the poses, on the nodes of :meth:`Pose.displacement`, mask pixels.
    """

    rest: Float64Array | None = None

    def __init__(self, display: Display) -> None:
        self.display = display
        height, width = display.mask.shape
        k = display.factor
        # Two samples per SLM pixel (or one per mask pixel where that is coarser) hold the sinc's main lobe.
        self.fine = 1 if k == 1 else 2
        self.shape = (display.slm_shape[0] * self.fine, display.slm_shape[1] * self.fine)
        mask = display.mask.field(display.wavelength_nm)
        self._spectrum = scipy.fft.fft2(np.conj(mask).astype(np.complex64))
        self._rows, self._columns = (scipy.fft.fftfreq(n, 1 / n).astype(int) for n in self.shape)
        pitch_mm = display.mask_pitch_um * 1e-3
        fy, fx = self._rows / (height * pitch_mm), self._columns / (width * pitch_mm)
        self._f2 = (np.pi * display.wavelength_nm * 1e-6 * (fy[:, None] ** 2 + fx**2)).astype(np.float32)
        # Cell centres of the coarser grid are (k / fine - 1) / 2 mask pixels past its first mask pixel.
        offset = (k / self.fine - 1) / 2
        self._centre = np.exp(
            2j * np.pi * offset * (self._rows[:, None] / height + self._columns / width)
        ).astype(np.complex64)
        box = [np.sinc(f * k / self.fine / n) for f, n in ((self._rows, height), (self._columns, width))]
        self._centre *= (box[0][:, None] * box[1]).astype(np.float32)
        y, x = (np.arange(n, dtype=np.float32) - (n - 1) / 2 for n in self.shape)
        scale = pitch_mm * k / self.fine
        self._y_mm, self._x_mm = y * scale, x * scale
        self._ones = np.ones(self.shape, np.complex64)
        self._levels = np.zeros(self.shape, np.uint8)
        self._last: tuple[float, npt.NDArray[np.complex64]] = (0.0, np.ones((1, 1), np.complex64))

    def field(self, spot: Spot) -> npt.NDArray[np.complex64]:
        """Return the SLM field that focuses one spot, complex64 (height, width) of the SLM."""
        from recon.holography import _kernels

        nodes = spot.pose.displacement(self.display.mask.shape)
        if self.rest is not None:
            nodes += self.rest
        # The mean displacement by a phase ramp, what differs from it by area: weighing the coarse grid's
        # cells costs light that depends on the place between them, which would pass for a shift.
        mean = _mean_of(nodes, spot.section, self.display.slm_shape)
        wave = self._at_slm(spot, mean)
        nodes = (nodes - mean) * (self.fine / self.display.factor)
        rows = (0, self.shape[0])
        if spot.section is not None:
            margin = int(np.abs(nodes[..., 0]).max()) + 2
            first, last = spot.section[0].start * self.fine, spot.section[0].stop * self.fine
            rows = (max(first - margin, 0), min(last + margin, self.shape[0]))
        out = np.zeros(self.display.slm_shape, np.complex64)
        one, row, column = np.ones(1, np.complex64), self._ones[:, 0], self._ones[0]
        _kernels.gather_displaced(
            out, wave, self._levels, one, row, column, nodes.astype(np.float32), self.fine, *rows
        )
        if spot.section is None:
            return out
        part = np.zeros_like(out)
        part[spot.section] = out[spot.section]
        return part

    def pattern(self, spots: Sequence[Spot], *, seed: int = 0) -> SpotPattern:
        """Superpose spots with random phases and keep the phase of the sum."""
        parts = [self.field(spot) for spot in spots]
        phases = np.exp(2j * np.pi * np.random.default_rng(seed).random(len(parts))).astype(np.complex64)
        total = sum(part * phase for part, phase in zip(parts, phases, strict=True))
        slm = np.exp(1j * np.angle(total)).astype(np.complex64)
        return SpotPattern(slm, tuple(spots), self.ideal(len(spots)))

    def shift_pattern(self, spots: Sequence[Spot], *, seed: int = 0) -> SpotPattern:
        """As :meth:`pattern` for poses that differ in shift and z only: much faster."""
        from recon.holography import _kernels

        height, width = self.display.mask.shape
        phases = np.exp(2j * np.pi * np.random.default_rng(seed).random(len(spots)))
        total = np.zeros(self.shape, np.complex64)
        layer = np.zeros_like(total)
        for z_um in sorted({spot.pose.z_um for spot in spots}):
            layer[:] = 0
            for spot, phase in zip(spots, phases, strict=True):
                if spot.pose.z_um == z_um:
                    ramp_y = phase * np.exp(-2j * np.pi * self._rows * (spot.pose.shift_y / height))
                    ramp_x = np.exp(-2j * np.pi * self._columns * (spot.pose.shift_x / width))
                    _kernels.add_shifted(
                        layer,
                        self._spectrum,
                        (self._rows - spot.row) % height,
                        (self._columns - spot.column) % width,
                        ramp_y.astype(np.complex64),
                        ramp_x.astype(np.complex64),
                    )
            total += layer * self._free_space(z_um) if z_um else layer
        field = scipy.fft.ifft2(total * self._centre, overwrite_x=True)
        n = self.fine
        binned = field.reshape(field.shape[0] // n, n, field.shape[1] // n, n).sum(axis=(1, 3))
        slm = np.exp(1j * np.angle(binned)).astype(np.complex64)
        return SpotPattern(slm, tuple(spots), self.ideal(len(spots)))

    # Steps -------------------------------------------------------------------------------------
    def _at_slm(self, spot: Spot, shift: Float64Array) -> npt.NDArray[np.complex64]:
        """Field in the SLM's image plane, two samples per SLM pixel, in the frame of a shifted mask."""
        pose = spot.pose
        height, width = self.display.mask.shape
        # Of the conjugate mask times a plane wave, at the frequencies that the SLM can make.
        window = np.ix_((self._rows - spot.row) % height, (self._columns - spot.column) % width)
        spectrum = self._spectrum[window] * self._centre
        spectrum *= np.exp(-2j * np.pi * self._rows * (shift[0] / height)).astype(np.complex64)[:, None]
        spectrum *= np.exp(-2j * np.pi * self._columns * (shift[1] / width)).astype(np.complex64)
        if pose.z_um:
            spectrum *= self._free_space(pose.z_um)
        wave = scipy.fft.ifft2(spectrum)
        reach = abs(pose.pitch_mrad * self._y_mm[-1]) + abs(pose.yaw_mrad * self._x_mm[-1])  # um at a corner
        if reach > FLAT * depth_um(self.display):
            depth = 1e-3 * (pose.pitch_mrad * self._y_mm[:, None] + pose.yaw_mrad * self._x_mm)
            depth = depth.astype(np.float32)
            # Second order in the depth: the probes tilt by far more than the mask ever is.
            spectrum *= np.complex64(1j) * self._f2
            wave += depth * scipy.fft.ifft2(spectrum)
            spectrum *= np.complex64(0.5j) * self._f2
            wave += depth**2 * scipy.fft.ifft2(spectrum, overwrite_x=True)
        return np.ascontiguousarray(wave, np.complex64)

    def _free_space(self, z_um: float) -> npt.NDArray[np.complex64]:
        """Return the factor that takes the light back by ``z_um`` (the last one is kept)."""
        if self._last[0] != z_um:
            self._last = (z_um, np.exp(np.complex64(1j * z_um * 1e-3) * self._f2))
        return self._last[1]

    def ideal(self, count: int) -> float:
        """Return the intensity of each of ``count`` spots where their pose is right.

        ``pi / 4`` of the light is left by keeping only the phase of a sum of random terms: mask pixels of an
        SLM pixel, several spots, or both, as it is one sum. A single spot without a finer mask loses nothing.
        """
        kept = 1.0 if self.display.factor == 1 and count == 1 else np.pi / 4
        return kept * self.display.slm_shape[0] * self.display.slm_shape[1] / count


def _mean_of(
    nodes: Float64Array, section: tuple[slice, slice] | None, slm_shape: tuple[int, int]
) -> Float64Array:
    """Return the displacement (y, x) in the middle of a section, or of the SLM."""
    parts = section or tuple(slice(0, n) for n in slm_shape)
    place = [
        (part.start + part.stop) / (2 * n) * (count - 1)
        for part, n, count in zip(parts, slm_shape, nodes.shape[:2], strict=True)
    ]
    j, i = (min(int(p), n - 2) for p, n in zip(place, nodes.shape[:2], strict=True))
    v, u = place[0] - j, place[1] - i
    left, right = (nodes[j, n] * (1 - v) + nodes[j + 1, n] * v for n in (i, i + 1))
    middle: Float64Array = left * (1 - u) + right * u
    return middle


def spread_spots(count: int, shape: tuple[int, int], *, seed: int = 0) -> list[tuple[int, int]]:
    """Return places for spots: integer bins from the axis, a jittered grid inside 0.38 of the field."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    cells = [(i, j) for i in range(side) for j in range(side)]
    rng.shuffle(cells)
    places = []
    for i, j in cells[:count]:
        y, x = ((np.array([i, j]) + 0.5 + rng.uniform(-0.15, 0.15, 2)) / side * 2 - 1) * 0.38
        places.append((round(y * shape[0]), round(x * shape[1])))
    return places
