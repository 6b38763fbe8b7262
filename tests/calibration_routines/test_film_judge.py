"""What the film demo says of a film: of a perfect one, and of one that shows nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration_routines.demos.film_figure import write_film_figure
from calibration_routines.demos.film_judge import judge, truth_of
from instrument.reconstruction.activity import Activity
from recon.optics.animal import draw_animal
from recon.streams.motion import Motion
from recon.streams.regions import Region, Search

SHAPE, PERIOD_S = (100, 240), 0.1


def film(*, shows: bool) -> tuple[Activity, object]:
    """Return a film of the animal, each light in its own pixels; regions at a cell, on tissue, on nothing."""
    animal = draw_animal(2500.0, 1000.0, seed=1)
    times = PERIOD_S * np.arange(120)
    truth = truth_of(animal, times, (50, 120), 10.0, 3800.0)
    frames = np.full((len(times), *SHAPE), 0.01, np.float32)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]

    def add(places: np.ndarray, courses: np.ndarray) -> None:
        for (row, column), course in zip(places, courses, strict=True):
            box = np.s_[int(row) - 2 : int(row) + 4, int(column) - 2 : int(column) + 4]
            spot = np.exp(-((y[box] - row) ** 2 + (x[box] - column) ** 2) / 0.5).astype(np.float32)
            frames[:, *box] += course[:, None, None].astype(np.float32) * spot

    add(truth.cells_px, 1 + shows * truth.change)
    if shows:
        add(truth.vessel_px, np.array([animal.blood(t) for t in times]).T)
    rng = np.random.default_rng(0)
    frames += rng.normal(0, 1e-3, frames.shape).astype(np.float32)
    cell = truth.cells_px[np.flatnonzero(truth.clear & (truth.change.max(axis=1) > 0.1))[0]]
    still = truth.tissue_px[np.argmax(np.hypot(*(truth.tissue_px[:, None] - truth.cells_px).T).min(axis=0))]
    far = (2.0, 2.0)
    regions = [
        Region(np.array([int(row)]), np.array([int(column)]), (float(row), float(column)), 1.0)
        for row, column in (cell, still, far)
    ]
    found = Activity(
        indices=tuple(range(len(times))),
        times_s=times,
        frames=frames,
        dff=frames,
        search=Search(regions, {}, frames[0]),
        traces=frames[:, 0, :2].T,
        motion=Motion(np.zeros((len(times), 2)), 0.0),
        faded=0.0,
    )
    return found, truth


@pytest.mark.parametrize("shows", [True, False])
def test_cells_regions_and_blood_are_told_as_they_are(shows: bool, tmp_path: Path) -> None:
    found, truth = film(shows=shows)
    judged = judge(found, truth, PERIOD_S, 300)
    assert judged.clear_active >= 5
    assert (judged.found, judged.cells_found, judged.on_tissue, judged.elsewhere) == (1, 1, 1, 1)
    if shows:
        assert judged.followed_clear == 1
        assert judged.median_um_s == pytest.approx(judged.true_median_um_s, rel=0.05)
    else:
        assert judged.followed_clear == 0
    if shows:
        write_film_figure(tmp_path / "film.png", found, truth, judged)
        assert (tmp_path / "film.png").stat().st_size > 10_000
