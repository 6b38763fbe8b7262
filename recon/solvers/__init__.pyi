# What `import recon.solvers` offers: each name with its home, from which `__init__.py` imports it.

from recon.solvers.admm import Admm as Admm
from recon.solvers.admm import Penalties as Penalties
from recon.solvers.base import IterationRecord as IterationRecord
from recon.solvers.base import Outcome as Outcome
from recon.solvers.base import Solver as Solver
from recon.solvers.base import StoppingRules as StoppingRules
from recon.solvers.base import StopReason as StopReason
from recon.solvers.fista import Fista as Fista
from recon.solvers.sensor_admm import SensorAdmm as SensorAdmm
from recon.solvers.wiener_filter import wiener as wiener
