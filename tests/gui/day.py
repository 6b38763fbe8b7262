"""An operator's day by clicks and keys alone, step by step, from a start in an empty folder.

``tests/gui/test_operators_day.py`` samples it; ``benchmarks/gui_day.py`` goes through all of it.
"""

from tests.gui import day_first_hour, day_results  # each adds its steps, in this order
from tests.gui.by_hand import STEPS, Operator

__all__ = ["STEPS", "Operator", "day_first_hour", "day_results"]
