"""Tables are read by other programs: one name a column, plain numbers below."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np

from instrument.reconstruction.film import curves_csv
from instrument.tasks.optics import optics_csv
from recon.evaluation.optics_compared import Compared


def _read(text: str) -> np.ndarray:
    return np.genfromtxt(io.StringIO(text), delimiter=",", names=True, dtype=None, encoding="utf-8")


def test_the_comparison_of_optics_is_numbers() -> None:
    none = np.zeros((1, 1), np.float32)
    found = {
        name: Compared(none[None], none, none, {}, {1e6: 20.5, 3e4: 13.25}, none[None], 21.0, 0.5)
        for name in ("a b", "c")
    }
    table = _read(optics_csv(found))
    assert table["optics"].tolist() == ["a b", "c"]
    numbers = [table[name].tolist() for name in table.dtype.names[1:]]
    assert numbers == [[13.25, 13.25], [20.5, 20.5], [21.0, 21.0], [0.5, 0.5]]


def test_times_of_a_long_film_differ_from_picture_to_picture() -> None:
    indices = (2_000_000, 2_000_001, 2_000_002)
    for period in (0.01, None):
        times = np.array(indices) * (period or 1.0)
        film = SimpleNamespace(
            read=lambda _: np.zeros((4, 4)), period_s=period, indices=indices, times_s=times
        )
        table = _read(curves_csv(film, [(slice(None), slice(None))], np.ones((1, 3))))  # type: ignore[arg-type]
        np.testing.assert_allclose(table["time_s" if period else "frame_number"], times, rtol=1e-12)
