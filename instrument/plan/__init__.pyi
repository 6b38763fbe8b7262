# What `import instrument.plan` offers: each name with its home, from which `__init__.py` imports it.

from instrument.plan.abilities import BenchAbilities as BenchAbilities
from instrument.plan.abilities import PlanEstimate as PlanEstimate
from instrument.plan.abilities import check as check
from instrument.plan.abilities import estimate as estimate
from instrument.plan.model import Part as Part
from instrument.plan.model import Plan as Plan
from instrument.plan.model import PlanError as PlanError
from instrument.plan.model import Step as Step
from instrument.plan.patterns import OFF as OFF
from instrument.plan.patterns import SOURCE as SOURCE
from instrument.plan.patterns import Light as Light
from instrument.plan.positions import SourceGrid as SourceGrid
from instrument.plan.positions import SourcePoints as SourcePoints
from instrument.plan.positions import SourcePosition as SourcePosition
from instrument.plan.positions import Span as Span
from instrument.plan.positions import StagePoints as StagePoints
