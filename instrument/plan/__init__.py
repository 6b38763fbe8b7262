"""Plans: what an acquisition will do, as data that counts, checks and iterates itself into steps."""

from instrument.plan.abilities import BenchAbilities, PlanEstimate, check, estimate
from instrument.plan.model import Part, Plan, PlanError, Step
from instrument.plan.patterns import OFF, SOURCE, Light
from instrument.plan.positions import SourceGrid, SourcePoints, SourcePosition, Span, StagePoints

__all__ = [
    "OFF",
    "SOURCE",
    "BenchAbilities",
    "Light",
    "Part",
    "Plan",
    "PlanError",
    "PlanEstimate",
    "SourceGrid",
    "SourcePoints",
    "SourcePosition",
    "Span",
    "StagePoints",
    "Step",
    "check",
    "estimate",
]
