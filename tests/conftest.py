"""For all tests: property tests are not judged by the clock of a machine that does other things, too.

With ``CI`` in the environment they try the same examples every time: what continuous integration says of a
change is about that change. Everywhere else they look for new ones.
"""

from __future__ import annotations

import os

# Several test processes share the cores. It is read when NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import HealthCheck, settings

settings.register_profile(
    "diffuserbench",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=bool(os.environ.get("CI")),
)
settings.load_profile("diffuserbench")

try:
    import PySide6.QtWidgets  # noqa: F401 # needs libraries of the system, too
    import pytestqt  # noqa: F401
except ImportError:
    pass  # tests/gui says so, test by test
else:
    pytest_plugins = ["pytestqt.plugin"]
