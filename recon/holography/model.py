"""The forward model from SLM to seen image, its loss, and the gradient of that loss.

In symbols (Kuo 2020, Eqs. 7.8, 7.15, 7.19, 7.22 and A.7), DC term ``d`` and envelope ``e`` added::

    a   = m h_z U (alpha s + d)              field behind the mask, zero-padded to the band's grid
    y   = F a                                field in the image plane
    I   = e |y|^2, summed over frames        intensity
    g   = c_s F^-1 { c_f F { I - target } }  what is counted
    L   = 1/2 mean(g^2)                      summed over planes

Only the kept lags of ``F I`` are ever formed, and ``I`` only a few rows at a time. Intensities are in units
of the mean that an SLM of amplitude 1 and random phases gives, so ``L`` does not depend on sizes, nor on the
light that a displaced mask loses where its cells see two SLM pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base.declare import with_overrides
from recon.base.fft import irfft, rfft
from recon.base.namespace import array_namespace
from recon.base.threads import get_threads, in_blocks
from recon.errors import InputError
from recon.holography.display import Display
from recon.holography.losses import loss_of
from recon.holography.near import NearField
from recon.holography.on_device import OnDevice, Tables
from recon.holography.options import HologramOptions
from recon.holography.panel import Panel
from recon.holography.target import BESIDE, Target, Window, band_of, weights_on

_ELSEWHERE = 0.3
"""Weight of darkness beside a picture whose amplitude mirrors code: what is there is noise when coded."""
_BANDS = 8
"""Mask row bands with accumulators of their own in the adjoint of a displaced mask; fixed, so that sums do
not depend on the number of threads."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Loss and gradient at one SLM pattern.

    Attributes
    ----------
    loss : float
    gradient : ndarray, complex, (n_frames, height, width)
        Wirtinger gradient ``(dL/ds)^*``; a real change ``ds`` changes the loss by ``2 Re <gradient, ds>``.
    seen_psnr_db : float
        PSNR of the low-passed image over the whole field (all planes), the target's white as peak.
    """

    loss: float
    gradient: Array
    seen_psnr_db: float


class HologramModel:
    """Computes what an SLM pattern shows and how to change it.

    Work arrays are allocated once; :attr:`nbytes` says how much. Not thread safe; use one per thread.

    Parameters
    ----------
    display : Display
    targets : sequence of Target
        One per plane; planes share the loss.
    options : HologramOptions
        Loss, weights, grid, frames and the kind of SLM make the model; the search takes the rest.
    dtype : complex64 or complex128
    **overrides
        Single options.
    """

    def __init__(
        self,
        display: Display,
        targets: Sequence[Target],
        options: HologramOptions | None = None,
        *,
        dtype: npt.DTypeLike = np.complex64,
        **overrides: Any,
    ) -> None:
        if not targets:
            raise InputError("A hologram needs at least one target.")
        from recon.holography import _kernels  # late: numba takes half a second to import

        self._kernels = _kernels
        options = with_overrides(options or HologramOptions(), overrides)
        if display.learned is not None and (options.complex_slm or options.mirrors is not None):
            raise InputError("What was learned of the display is of a phase SLM; leave it out for others.")
        if display.near and options.mirrors is not None:
            raise InputError("Mirrors show far pictures: behind a lens, or farther away without one.")
        self.display = display
        self.targets = tuple(targets)
        self.options = options
        self.window = self._window_of()
        self.loss = loss_of(options.loss)
        if self.window is not None and not self.loss.takes_weights:
            if not (self.loss.mean_square and self.loss.low_passed):
                raise InputError(
                    f"A picture in a part of the field goes with the losses 'frequency' and 'spatial', not "
                    f"{self.loss.name!r}."
                )
            self.loss = loss_of("spatial")
        self.frames = options.frames
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        self._real: np.dtype[Any] = np.empty(0, self.dtype).real.dtype
        unfiltered = not self.loss.low_passed
        self.band = band_of(display, options.grid, unfiltered=unfiltered)
        # What needs room to be computed comes before the large arrays, one after the other.
        spectra = [self._spectrum_of(target) for target in self.targets]
        self._wanted = [spectrum for spectrum, _ in spectra]
        self.peaks = tuple(peak for _, peak in spectra)
        self._cutoff = 0.0 if unfiltered else self.band.cutoff
        self._weights: Array | None = None
        self._wanted_images: list[Array | None] = [None] * len(self.targets)
        if not self.loss.mean_square:
            height, width = self.band.seen_shape
            if (weights := options.field_weights()) is not None:
                self._weights = weights_on(weights, (height, width)).astype(self._real)
            if self.window is not None:
                asked = np.zeros((height, width), self._real)
                if options.mirrors == "lee":
                    asked[BESIDE.part((height, width))] = _ELSEWHERE
                asked[self.window.part((height, width))] = 1
                asked = np.fft.ifftshift(asked)
                self._inside = np.asarray(asked == 1, self._real)
                self._weights = asked if self._weights is None else asked * self._weights
            self._small = np.empty((height, width // 2 + 1), self.dtype)
            self._seen = np.empty((height, width), self._real)
            if self.loss.takes_wanted:
                self._wanted_images = [self._image_of(s, self._cutoff) for s in self._wanted]
        self._field = np.zeros((self.frames, *self.band.shape), self.dtype)
        self._spectrum = np.empty((self.band.shape[0], self.band.kept[1]), self.dtype)
        depths = [target.z_mm for target in self.targets]
        self._near = NearField(display, depths, self.band.aperture[0], self.dtype) if display.near else None
        flat = tuple(np.ones(n, self.dtype) for n in display.mask.shape)
        self._defocus = [
            flat if display.near else tuple(h.astype(self.dtype) for h in display.defocus(z)) for z in depths
        ]
        self._nodes: Array | None = None
        self._mean_light = 1.0
        self.xp = array_namespace(options.device)
        self.take(display)
        self._mean_light = self._mean_power()
        self._table *= self._real.type(1 / np.sqrt(self._mean_light))

    @property
    def wraps(self) -> bool:
        """Whether what is shown jumps where a phase does."""
        return self._panel is not None

    def hold(self, slm: Array | None, *, within: bool = False) -> None:
        """Let phases run on beyond a turn from those of these patterns, in all that follows; None: wrap.

        ``within``: they stop at its ends; :meth:`stopped` are the patterns that are shown then.
        """
        if self._panel is not None:
            self._panel.hold(slm, within=within)

    def stopped(self, slm: Array) -> Array:
        """Return the patterns that are shown of these while phases stop at the ends of a turn."""
        return slm if self._panel is None else self._panel.stopped(slm)

    def take(self, display: Display) -> None:
        """Model another display of the same size, mask and lens; targets and light stay in their units."""
        self.display = display
        self._panel = None if display.learned is None else Panel(display, self.dtype)
        nodes = display.displacement
        self._nodes = None if nodes is None else np.ascontiguousarray(nodes, dtype=self._real)
        aperture = np.sqrt(1.0 / np.prod(display.mask.shape) / self.frames / self._mean_light)
        depth = 1.0 if display.learned is None else display.learned.mask_depth
        response = display.mask.response(display.wavelength_nm / depth) * aperture
        self._table = response.astype(self.dtype)
        ey, ex = display.transmitted(self.band.shape)
        self._ey, self._ex = ey.astype(self._real), ex.astype(self._real)
        self._there = None if self.xp is np else OnDevice(self.xp, self._tables())

    def _tables(self) -> Tables:
        """Return what a device computes with; InputError where it takes more than that knows."""
        display, options = self.display, self.options
        lacking = {
            "displaced masks": self._nodes is not None,
            "displays that were learned": self._panel is not None,
            "pictures near the SLM": display.near,
            "mirrors": options.mirrors is not None,
            f"the method {options.method!r}": options.method != "lbfgs",
        }
        if found := [what for what, there in lacking.items() if there]:
            raise InputError(f"On the {options.device} there are no {found[0]}: take the cpu.")
        return Tables(
            band=self.band,
            loss=self.loss,
            cutoff=self._cutoff,
            behind=[self._table[display.mask.levels] * hy[:, None] * hx for hy, hx in self._defocus],
            envelope=self._ey[:, None] * self._ex,
            wanted=self._wanted,
            images=self._wanted_images,
            peaks=self.peaks,
            weights=self._weights,
            inside=None if self.window is None or self.loss.mean_square else self._inside,
            factor=display.factor,
            modulated=display.dc.modulated,
            amplitude=display.dc.amplitude,
            dtype=self.dtype,
        )

    @property
    def counted(self) -> float:
        """Part of the field that the target counts in."""
        return 1.0 if self.window is None else float(self._inside.mean())

    @property
    def nbytes(self) -> int:
        """Bytes in the work arrays, without the mask itself and the optimiser's vectors."""
        arrays = [self._field, self._spectrum, *self._wanted]
        if not self.loss.mean_square:
            optional = [self._weights, *self._wanted_images]
            arrays += [self._small, self._seen, *(a for a in optional if a is not None)]
        return sum(a.nbytes for a in arrays) + (0 if self._near is None else self._near.nbytes)

    def evaluate(self, slm: Array) -> Evaluation:
        """Return loss, gradient and PSNR for SLM patterns, complex (n_frames, height, width)."""
        if self._there is not None:
            loss, gradient, error = self._there.evaluate(slm)
            return Evaluation(loss, gradient, -10 * np.log10(error) if error > 0 else np.inf)
        patterns = self._check(slm)
        gradient = np.zeros(patterns.shape, self.dtype)
        loss = 0.0
        errors = []
        for plane in range(len(self.targets)):
            self._intensity_spectrum(patterns, plane)
            plane_loss, error = self._loss(plane)
            errors.append(error / self.peaks[plane] ** 2)
            loss += plane_loss
            self._kernels.columns(self._spectrum, False, get_threads())
            for frame in range(self.frames):
                self._backward(frame, plane, gradient[frame])
        if self._panel is None:
            gradient *= self._real.type(self.display.dc.modulated)
        else:
            gradient = self._panel.back(np.asarray(slm, self.dtype), gradient)
        error = float(np.mean(errors))
        return Evaluation(loss, gradient, -10 * np.log10(error) if error > 0 else np.inf)

    def seen(self, slm: Array, plane: int = 0) -> Array:
        """Return the low-passed image, real, on the band's ``seen_shape``, the axis in the middle."""
        self._intensity_spectrum(self._check(slm), plane)
        return self._image(self._spectrum)

    def wanted(self, plane: int = 0) -> Array:
        """Return the low-passed target on the grid and in the units of :meth:`seen`."""
        return self._image(self._wanted[plane])

    def intensity(self, slm: Array, plane: int = 0) -> Array:
        """Return the intensity before any low-pass on the band's ``shape``, the centre in the middle."""
        self._intensity_spectrum(self._check(slm), plane)
        total = np.zeros(self.band.shape, self._real)
        for field in self._field:
            total += field.real**2 + field.imag**2
        total *= self._ey[:, None] * self._ex
        return np.fft.fftshift(total)

    def lags(self, slm: Array | None = None, plane: int = 0) -> Array:
        """Return Fourier coefficients at the kept lags, (rows, columns), of what is seen, or wanted."""
        if slm is None:
            return self._wanted[plane]
        return self.lags_of_field(self._check(slm), plane)

    def lags_of_field(self, fields: Array, plane: int = 0) -> Array:
        """Return :meth:`lags` of fields as they leave the SLM, all light included."""
        self._intensity_spectrum(fields, plane)
        rows, top = self.band.kept[0], self.band.top
        return np.concatenate([self._spectrum[:top], self._spectrum[len(self._spectrum) - rows + top :]])

    def efficiency(self, slm: Array) -> float:
        """Return the part of the light on the SLM that reaches the field, DC term and envelope included."""
        self._intensity_spectrum(self._check(slm), 0)
        passed = 1.0 if self._near is None else self._near.passed
        return float(self._spectrum[0, 0].real) * self._mean_light * passed

    def slope(self) -> Array:
        """Return the row spectra of ``dL/dI`` of the pattern that was evaluated last, for :meth:`weighed`."""
        return self._spectrum.copy()

    def weighed(self, field: Array, slope: Array) -> Array:
        """Take a field at the SLM, DC light included, to the first image plane, weigh it there, and back.

        ``slope``, from :meth:`slope`, is the weight: the result is the gradient by the field, (height,
        width), of the light weighed so; it is linear in the field.
        """
        self._intensity_spectrum(np.ascontiguousarray(field, self.dtype)[None], 0)
        self._spectrum[:] = slope
        out = np.zeros(self.display.slm_shape, self.dtype)
        self._backward(0, 0, out)
        return out

    def back_propagate(self, amplitude: Array, plane: int = 0) -> Array:
        """Return ``U^H m^* h^* F^-1 amplitude``: a field in the image plane integrated over the SLM pixels.

        ``amplitude`` is complex on the band's ``shape`` in FFT order (Kuo 2020, Eqs. 7.11 and 7.12, without
        taking the phase).
        """
        self._field[0] = amplitude
        spectrum = np.zeros_like(self._spectrum)
        spectrum[:, 0] = 1
        self._kernels.rows_from_spectrum(
            self._field[0],
            self._field[0].view(self._real),
            spectrum,
            np.ones_like(self._ey),
            np.ones_like(self._ex),
            1.0,
            0,
            self.band.shape[0],
        )
        panel = self._panel
        out = np.zeros(self.display.slm_shape if panel is None else panel.shape, self.dtype)
        self._columns_and_gather(0, plane, out)
        return out if panel is None else panel.collected(out)

    def _window_of(self) -> Window | None:
        window = self.targets[0].window
        if any(target.window != window for target in self.targets):
            raise InputError("The targets of one hologram count in the same part of the field.")
        return window

    # Steps -------------------------------------------------------------------------------------
    def _spectrum_of(self, target: Target) -> tuple[Array, float]:
        spectrum, peak = target.spectrum(self.display, self.band)
        share = self.options.share
        if self.display.near:  # the light beside its square goes nowhere else
            share *= min(self.display.mask.shape) / max(self.display.mask.shape)
        if not self.options.complex_slm and self.window is None:  # else there is light to spare
            share *= 1 - max(self.display.dimmed(target.z_mm) for target in self.targets)
        spectrum *= share
        return spectrum.astype(self.dtype), peak * share

    @property
    def _factor(self) -> int:
        """Mask pixels a sample of the SLM's field, along each axis."""
        return self.display.factor if self._panel is None else self._panel.factor

    def _mean_power(self) -> float:
        """Return the mean light that passes from an SLM of random phases, relative to a mask in place."""
        display = self.display
        sent = 1.0 if self._panel is None else self._panel.mean_power()
        if self._nodes is None:
            return sent
        mixed, covered = self._kernels.mean_power(
            self._nodes, display.mask.shape, display.slm_shape, display.factor
        )
        if covered == 0:
            raise InputError("The mask is displaced so far that it sees nothing of the SLM.")
        return float(sent * ((1 - display.dc.power) * mixed + display.dc.power * covered))

    def _check(self, slm: Array) -> Array:
        expected = (self.frames, *self.display.slm_shape)
        if slm.shape != expected:
            raise InputError(f"SLM patterns must be {expected}, not {slm.shape}.")
        if self._panel is not None:
            return self._panel.field(np.asarray(slm, self.dtype))
        dc = self.display.dc
        if dc.power == 0:
            return np.ascontiguousarray(slm, self.dtype)
        return np.ascontiguousarray(slm * dc.modulated + dc.amplitude, self.dtype)

    def _intensity_spectrum(self, patterns: Array, plane: int) -> None:
        """Fill ``_field`` with the image plane's fields and ``_spectrum`` with the intensity's kept lags."""
        mask, k = self.display.mask.levels, self._factor
        height, width = mask.shape
        hy, hx = self._defocus[plane]
        self._spectrum[:] = 0
        filled = self.band.aperture[1]
        for field, pattern in zip(self._field, patterns, strict=True):
            behind = field if self._near is None else self._near.canvas
            behind[height:, :width] = 0
            behind[:, width:filled] = 0

            def fill(start: int, stop: int, behind: Any = behind, pattern: Any = pattern) -> None:
                if self._nodes is None:
                    pairs = behind.view(self._real)
                    self._kernels.fill(pairs, pattern, mask, self._table, hy, hx, k, start, stop)
                else:
                    self._kernels.fill_displaced(
                        behind, pattern, mask, self._table, hy, hx, self._nodes, k, start, stop
                    )

            in_blocks(fill, height, grain=64)
            if self._near is not None:
                self._near.forward(field, plane)
            self._kernels.columns(field[:, :filled], True, get_threads())
            scale = 1.0 / np.prod(self.band.shape)

            def rows(start: int, stop: int, field: Any = field, scale: float = scale) -> None:
                self._kernels.rows_to_spectrum(
                    field,
                    field.view(self._real),
                    self._spectrum,
                    self._ey,
                    self._ex,
                    filled,
                    scale,
                    start,
                    stop,
                )

            in_blocks(rows, self.band.shape[0], grain=64)
        self._kernels.columns(self._spectrum, True, get_threads())

    def _loss(self, plane: int) -> tuple[float, float]:
        """Return loss and mean square error, and turn the kept lags into ``dL/dI``'s (Kuo 2020, Eq. A.9)."""
        band, spectrum = self.band, self._spectrum
        lags = (spectrum, self._wanted[plane], band.cutoff, band.top, band.full)
        if self.loss.mean_square and self._cutoff:
            error = self._kernels.filter_twice(*lags)
            return error / 2, error
        counted = error = self._kernels.filtered_power(*lags)
        if self._cutoff == 0:
            counted = self._kernels.filtered_power(spectrum, self._wanted[plane], 0.0, band.top, band.full)
        self._kernels.subtract_and_filter(spectrum, self._wanted[plane], self._cutoff, band.top)
        loss = counted / 2
        if not self.loss.mean_square:
            self._kernels.copy_kept(spectrum, self._small, *band.kept, band.top)
            irfft(self._small, self._seen.shape[1], out=self._seen)
            self._seen *= self._real.type(self._seen.size)
            if self.window is not None:
                error = float(np.vdot(self._seen * self._inside, self._seen) / self._inside.sum())
            loss, gradient = self.loss.evaluate(self._seen, self._wanted_images[plane], self._weights)
            rfft(np.ascontiguousarray(gradient, self._real), out=self._small)
            self._kernels.copy_kept(self._small, spectrum, *band.kept, band.top)
        self._kernels.low_pass(spectrum, band.kept[0], self._cutoff, band.top)
        return loss, error

    def _image(self, spectrum: Array) -> Array:
        """Return the low-passed image of a half spectrum, the field's centre in the middle."""
        return np.fft.fftshift(self._image_of(spectrum, self.band.cutoff))

    def _image_of(self, spectrum: Array, cutoff: float) -> Array:
        """Return the image of a half spectrum in FFT order, low-passed where the cut-off is above 0."""
        height, width = self.band.seen_shape
        small = np.empty((height, width // 2 + 1), self.dtype)
        self._kernels.copy_kept(spectrum, small, *self.band.kept, self.band.top)
        self._kernels.low_pass(small, self.band.kept[0], cutoff, self.band.top)
        image = irfft(small, width)
        image *= self._real.type(height * width)
        return image

    def _backward(self, frame: int, plane: int, out: Array) -> None:
        field = self._field[frame]
        scale = 1.0 / np.prod(self.band.shape)

        def rows(start: int, stop: int) -> None:
            pairs = field.view(self._real)
            self._kernels.rows_from_spectrum(
                field, pairs, self._spectrum, self._ey, self._ex, scale, start, stop
            )

        in_blocks(rows, self.band.shape[0], grain=64)
        self._columns_and_gather(frame, plane, out)

    def _columns_and_gather(self, frame: int, plane: int, out: Array) -> None:
        mask, k, nodes = self.display.mask.levels, self._factor, self._nodes
        height = mask.shape[0]
        hy, hx = self._defocus[plane]
        field = self._field[frame]
        self._kernels.columns(field[:, : self.band.aperture[1]], False, get_threads())
        if self._near is not None:
            self._near.back(field, plane)
            field = self._near.canvas
        if nodes is None:

            def gather(start: int, stop: int) -> None:
                pairs = field.view(self._real)
                self._kernels.gather(out, pairs, mask, self._table, hy, hx, k, start, stop)

            in_blocks(gather, out.shape[0], grain=16)
            return
        edges = [height * band // _BANDS for band in range(_BANDS + 1)]
        parts = [_rows_seen(nodes, edges[n], edges[n + 1], height, k, out.shape[0]) for n in range(_BANDS)]
        sums = [np.zeros((last - first, out.shape[1]), self.dtype) for first, last in parts]

        def scatter(start: int, stop: int) -> None:
            for n in range(start, stop):
                moved = nodes - np.array([parts[n][0] * k, 0], nodes.dtype)
                self._kernels.gather_displaced(
                    sums[n], field, mask, self._table, hy, hx, moved, k, edges[n], edges[n + 1]
                )

        in_blocks(scatter, _BANDS)
        for (first, last), part in zip(parts, sums, strict=True):
            out[first:last] += part


def _rows_seen(nodes: Array, start: int, stop: int, height: int, k: int, slm_rows: int) -> tuple[int, int]:
    """Return the SLM rows that mask rows ``start`` to ``stop`` may see through a displacement."""
    per_node = (nodes.shape[0] - 1) / height
    around = nodes[int(start * per_node) : int(np.ceil(stop * per_node)) + 1, :, 0]
    first = int(np.floor((start + around.min()) / k))
    last = int(np.floor((stop + around.max()) / k)) + 2
    first = min(max(first, 0), slm_rows)
    return first, max(min(last, slm_rows), first)
