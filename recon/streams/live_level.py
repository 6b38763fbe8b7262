"""One resolution of the live reconstruction: the camera on binned pixels, its filter and its solver."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.blocks import block_mean
from recon.base.noise import NoiseModel, averaged_noise
from recon.camera.convolution import Convolution
from recon.priors import NonNegativity, TotalVariation
from recon.reconstruction.measurement import channel_noise
from recon.reconstruction.weights import default_tau
from recon.solvers.sensor_admm import SensorAdmm
from recon.solvers.wiener import WienerFilter, cross_validated

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]


class FilterLevel:
    """Wiener pictures at one binning: made in a moment, for the first picture.

    Parameters
    ----------
    psfs : ndarray, float32, (n_channels or 1, height, width)
        In unbinned pixels of the calibration.
    binning : int
        Pixels averaged along each axis.
    frame : ndarray, float32, (n_channels, height, width)
        A first frame on binned pixels, background subtracted: sets noise and regularisation.
    noise : NoiseModel or float, optional
        Of an unbinned pixel; default: estimated from ``frame``.
    """

    def __init__(self, psfs: Floats, binning: int, frame: Floats, noise: NoiseModel | float | None) -> None:
        self.binning = binning
        binned_psfs = block_mean(psfs, binning)
        deviation = [_noise(channel, noise, binning) for channel in frame]
        self._deviation = np.array(deviation, np.float32)[:, None, None]
        energy = np.sqrt(np.sum(binned_psfs.astype(np.float64) ** 2, axis=(1, 2))).astype(np.float32)
        energy = energy[:, None, None]
        self.camera = Convolution(binned_psfs / energy, frame.shape[1:], n_channels=len(frame))
        # One binned pixel holds the light of all its pixels: in units of one, pictures of all binnings agree.
        self._image_scale = self._deviation / energy / np.float32(binning**2)
        self.filter = WienerFilter(self.camera, cross_validated(self.camera, self.data(frame)))

    def data(self, frame: Floats) -> Floats:
        """Return a frame on binned pixels in units of its noise."""
        return frame / self._deviation

    def filtered(self, frame: Floats) -> Floats:
        """Return Wiener's picture of a frame on binned pixels, (n_channels, height, width)."""
        return self._picture(np.maximum(self.filter(self.data(frame)), 0))

    def _picture(self, solution: Array) -> Floats:
        (row, column), (height, width) = self.camera.centre, self.camera.sensor_shape
        top, left = row - height // 2, column - width // 2
        window = solution[:, top : top + height, left : left + width]
        picture: Floats = window * self._image_scale
        return picture


class Level(FilterLevel):
    """Pictures at one binning, with a solver: parameters as of :class:`FilterLevel`."""

    def __init__(self, psfs: Floats, binning: int, frame: Floats, noise: NoiseModel | float | None) -> None:
        super().__init__(psfs, binning, frame, noise)
        data = self.data(frame)
        peak = float(np.max(np.abs(self.camera.adjoint(data))))
        weight = default_tau("tv", "picture", peak) * peak
        self.solver = SensorAdmm(self.camera, data, TotalVariation(weight) + NonNegativity())
        self.solver.compile()
        self.solver.advance()  # the first finds memory and threads, at a picture's cost

    def solved(self) -> Floats:
        """Return the solver's present picture, (n_channels, height, width)."""
        return self._picture(self.solver.solution)


class ComingLevel:
    """A level being made in a thread of its own, while pictures go on at the one before.

    Parameters
    ----------
    binning : int
    make : callable
        Returns the level, of this binning.
    """

    def __init__(self, binning: int, make: Callable[[], Level]) -> None:
        self.binning = binning
        self._make = make
        self._made: Level | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="live level")
        self._thread.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the level is made, or the time is over; return whether it is made."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def result(self) -> Level:
        """Return the level; waits for it, and raises what went wrong with it."""
        self.wait()
        if self._error is not None:
            raise self._error
        assert self._made is not None
        return self._made

    def _work(self) -> None:
        try:
            self._made = self._make()
        except Exception as error:  # noqa: BLE001 - raised where the level is asked for
            self._error = error


def _noise(channel: Floats, noise: NoiseModel | float | None, binning: int) -> float:
    """Return a binned pixel's noise: averaging divides the deviation of white noise by ``binning``."""
    valid = np.ones(channel.shape, bool)
    return channel_noise(channel, valid, averaged_noise(noise, binning**2))
