"""Solvers: an operator, data and a prior in; an object, a history and the reason to stop out."""

from recon.solvers.admm import Admm, Penalties
from recon.solvers.base import IterationRecord, Outcome, Solver, StoppingRules, StopReason
from recon.solvers.fista import Fista
from recon.solvers.sensor_admm import SensorAdmm
from recon.solvers.wiener import wiener

__all__ = [
    "Admm",
    "Fista",
    "IterationRecord",
    "Outcome",
    "Penalties",
    "SensorAdmm",
    "Solver",
    "StopReason",
    "StoppingRules",
    "wiener",
]
