"""What every driver must do, as test suites: ``from drivers.testing.stage import StageContract``.

For tests alone, of this project's drivers and of others': it needs pytest, and nothing else imports it.
"""

import pytest

pytest.register_assert_rewrite(f"{__name__}.device", f"{__name__}.camera", f"{__name__}.stage")
pytest.register_assert_rewrite(f"{__name__}.led_array", f"{__name__}.slm")
