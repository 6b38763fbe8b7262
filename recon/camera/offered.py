"""Camera models beside the convolutions: one of a user's own is an operator by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from recon.base.registry import Registry
from recon.camera.base import LinearOperator
from recon.camera.convolution3d import Convolution3D

if TYPE_CHECKING:
    from recon.camera.camera_model import Depths


@dataclass(frozen=True, kw_only=True)
class OfferedCamera:
    """A camera model as it is registered.

    Attributes
    ----------
    name, help : str
        ``name`` is what the option ``model`` takes.
    make : callable
        ``make(central, depths)`` returns the operator of one channel: domain (1, n_z, height, width) and
        range (1, sensor height, sensor width) of ``central``, the convolution with each depth's central PSF
        in the problem's units, which solvers precondition with.
    refuses : callable, optional
        ``refuses(depths)`` returns why a calibration does not give such a camera; None where it does.
    """

    name: str
    help: str
    make: Callable[[Convolution3D, Depths], LinearOperator]
    refuses: Callable[[Depths], str | None] = lambda _: None


def _none() -> Iterable[OfferedCamera]:
    return ()


CAMERAS: Registry[OfferedCamera] = Registry("camera model", "diffuserbench.cameras", _none)
"""Camera models of others. The project's own three share their PSFs' preparation: ``camera_model.MODELS``."""
