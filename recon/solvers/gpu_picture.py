"""A picture on any device: the solver for one depth, channel by channel."""

from __future__ import annotations

import numpy as np

from recon.base.namespace import Namespace
from recon.camera.base import Array, LinearOperator
from recon.errors import StructureError
from recon.priors.base import Prior
from recon.solvers.gpu_base import ChannelByChannel, PlainSolver
from recon.solvers.gpu_camera import DepthCamera
from recon.solvers.gpu_douglas_rachford import PlainDouglasRachford
from recon.solvers.gpu_total_variation import PlainTotalVariation
from recon.solvers.prior_splits import split_prior
from recon.solvers.structure import as_cropped_convolution


def picture_solver(
    xp: Namespace, operator: LinearOperator, data: Array, prior: Prior, initial: Array | None = None
) -> ChannelByChannel:
    """Return a solver for a (masked) :class:`~recon.camera.convolution.PadCropConvolution`.

    Parameters
    ----------
    xp : module
        ``numpy`` or ``cupy``.
    operator, data, prior, initial
        As of :class:`~recon.solvers.SensorAdmm`; the prior total variation or l1, with non-negativity.

    Raises
    ------
    StructureError
        When operator or prior are something else.
    """
    structure = as_cropped_convolution(operator)
    camera = structure.convolution
    tv, separable, others = split_prior(prior)
    if others:
        names = ", ".join(type(other).__name__ for other in others)
        raise StructureError(
            f"On a GPU the prior is total variation or l1, with non-negativity; got {names}."
        )
    bounds = (separable.lower, separable.upper)
    if bounds != (0.0, np.inf) or (tv and separable.weight > 0):
        raise StructureError(
            "On a GPU the prior is total variation or l1, with non-negativity; "
            f"got bounds {bounds[0]:g} to {bounds[1]:g}"
            + (" and both penalties." if tv and separable.weight > 0 else ".")
        )
    window = camera.sensor_window[1:]
    solvers: list[PlainSolver] = []
    for channel, image in enumerate(data):
        H = camera.spectrum[channel % len(camera.spectrum)][None]
        valid = structure.weight[channel] > 0
        plain = DepthCamera(xp, H, (camera.grid_shape[0], camera.grid_shape[1]), window, valid)
        start = None if initial is None else initial[channel][None]
        if tv:
            solvers.append(
                PlainTotalVariation(plain, image, tv.weight, isotropic=tv.isotropic, initial=start)
            )
        else:
            solvers.append(PlainDouglasRachford(plain, image, separable.weight, initial=start))
    return ChannelByChannel(solvers)
