"""A frame is shown before what shows it fast is compiled, and looks the same."""

from __future__ import annotations

import threading
from typing import Any, NoReturn

import numpy as np
import pytest

from instrument.live import frame_view
from instrument.live.frame_view import SATURATED, fill_indices, index_table, show_indices


def _hangs(*_: Any) -> NoReturn:
    raise AssertionError("it would have waited for a compiler")


@pytest.mark.parametrize("step", [1, 2, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_numpy_shows_until_then_is_what_is_shown_later(
    step: int, dtype: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 200, (31, 44)).astype(dtype)
    image[rng.random(image.shape) < 0.05] = 250  # saturated pixels here and there
    image.flags.writeable = False
    table = index_table(dtype, 20, 180, full_scale=250)
    for turned in (image, image.T, image[::-1]):
        height, width = (side // step for side in turned.shape)
        soon, later = (np.zeros((height, width), np.uint8) for _ in range(2))
        fill_indices(turned, table, step, later)
        with monkeypatch.context() as early:
            early.setattr(frame_view, "_compiled", threading.Event())
            early.setattr(frame_view, "fill_indices", _hangs)
            show_indices(turned, table, step, soon)
        np.testing.assert_array_equal(soon, later)
        assert (later == SATURATED).any()
