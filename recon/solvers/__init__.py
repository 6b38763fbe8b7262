"""Solvers: an operator, data and a prior in; an object, a history and the reason to stop out."""

from recon.solvers.base import Outcome, Solver
from recon.solvers.fista import Fista
from recon.solvers.stopping import IterationRecord, StoppingRules, StopReason

__all__ = ["Fista", "IterationRecord", "Outcome", "Solver", "StopReason", "StoppingRules"]
