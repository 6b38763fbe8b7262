"""Boundaries of failure are where they were: moved by more than a stated tolerance, a test shows the map.

Coarse and seeded. The dissertation's own boundaries first; that one PSF fails under a fall-off where points
every 0.4 mm serve is held in tests/recon/test_calibration_spacing.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.interpolate import griddata

from recon.analysis.gram import WindowProblem
from recon.analysis.point_noise import Noise
from recon.analysis.points import DIP, PointGrid, try_points
from recon.analysis.resolution import axial_resolution
from recon.evaluation.lenslets import build_camera
from recon.evaluation.map_trials import local_condition
from recon.evaluation.maps import map_named
from recon.evaluation.scene import SceneSpec
from recon.evaluation.scene_trial import Options, judge_image, run_scene, scene_of, solve
from recon.verdict.map import boundary, worst

if TYPE_CHECKING:
    from tests.recon.conftest import DrawnMap


@pytest.fixture(autouse=True)
def _calibrations_are_not_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against decoys, which costs more than these reconstructions and changes no error of theirs."""
    monkeypatch.setattr("recon.reconstruction.reconstruct.check_calibration", lambda *_, **__: None)


POINTS = SceneSpec("beads", size=40, seed=7, depths=1, layers=(0.5, 0.5))


def test_the_local_condition_number_saturates_with_the_number_of_sources(drawn_map: DrawnMap) -> None:
    """Kuo 2020, Fig. 4.5: each doubling of the points costs less than the one before, and closer is worse."""
    camera = build_camera(96, optics="smooth", seed=0, focus=6.0)
    counts, separations = (2, 4, 8, 16), (1.5, 2.0, 3.0, 4.0)
    rows = {n: [local_condition(camera, n, s) for s in separations] for n in counts}

    def shown() -> str:
        return drawn_map("separation in pixels", separations, "points", rows)

    growth = np.array([np.divide(rows[b], rows[a]) for a, b in ((2, 4), (4, 8), (8, 16))])
    assert (growth > 1).all(), shown()
    assert (growth[1] < growth[0]).all(), shown()
    assert (growth[2] < 1.35).all(), shown()
    assert (np.diff(list(rows.values()), axis=1) < 0).all(), shown()
    # Where it was on 2026-11-22, within 15 %.
    assert rows[16][0] == pytest.approx(6.6, rel=0.15), shown()


def test_sixteen_points_need_more_room_than_two(drawn_map: DrawnMap) -> None:
    """Kuo 2020, Fig. 4.4: resolved at 1.7 times the spacing at which two are, and not at that of two."""
    camera = build_camera(96, optics="smooth", seed=0, focus=3.0)
    z_um = 3.0 * camera.distance_um

    def at(columns: float, inverse: float) -> np.ndarray:
        return camera.light(
            [[-columns * camera.pitch_um / camera.distance_um / inverse, 0.0, 1 / inverse, 1.0]]
        )

    step = axial_resolution(at(0.0, 1 / z_um), z_um, camera.distance_um, 0.8).step_per_um
    planes = 1 / z_um - step / 2 * (np.arange(19) - 9)
    assert planes[-1] > 0

    def image(columns: float, plane: float) -> np.ndarray:
        inverse = float(np.interp(plane, np.arange(19), planes))
        return at(columns, inverse) / inverse**2

    stack = np.stack([image(0.0, k) for k in range(19)])

    def dip(columns: int, depths: int, px: float, apart: float) -> float:
        half = (2, int(px * (columns - 1) / 2) + 3)
        window = WindowProblem(stack[9:10], half) if depths == 1 else WindowProblem(stack, half)
        return try_points(
            window,
            image if depths > 1 else lambda c, _s: image(c, 9),
            PointGrid(columns, depths, px, apart),
            Noise(),
            trials=1,
        ).dip

    lateral = next(px for px in (1.5, 1.75, 2.0, 2.25, 2.5) if dip(2, 1, px, 0.0) >= DIP)
    axial = next(s for s in (1.5, 2.0, 2.5, 3.0, 3.5) if dip(1, 2, 0.0, s) >= DIP)
    factors = (1.0, 1.7)
    dips = [dip(4, 4, f * lateral, f * axial) for f in factors]

    def shown() -> str:
        severities = {f"two need {lateral} px, {axial} planes": [DIP / max(d, 1e-2) for d in dips]}
        return drawn_map("spacing of sixteen, times that of two", factors, "points", severities)

    assert dips[0] < DIP, shown()
    assert dips[1] >= DIP, shown()


def test_eighty_percent_erased_in_the_diffusers_domain_and_in_the_images(drawn_map: DrawnMap) -> None:
    """Kuo 2020, Fig. 3.7: the diffuser spreads every point over pixels enough; an image loses it."""
    shares, draws = (0.4, 0.8, 0.95), 3
    drawn = np.zeros((draws, 2, len(shares)))
    for draw in range(draws):
        few = replace(POINTS, size=56, density=0.5, photons=3000.0, seed=POINTS.seed + draw)
        full = solve(scene_of(few), "admm l1", Options(), 100).image
        for k, share in enumerate(shares):
            scene = scene_of(replace(few, erased=share))
            assert scene.erasures is not None
            kept = ~scene.erasures
            grid = np.indices(kept.shape).reshape(2, -1).T
            interpolated = griddata(np.argwhere(kept), full[kept], grid, fill_value=0.0).reshape(kept.shape)
            found = solve(scene, "admm l1", Options(), 100).image
            for row, image in enumerate((interpolated, found)):
                _, severities = judge_image(scene, image[None], scene.truth.reshape(1, *kept.shape))
                drawn[draw, row, k] = worst(severities)[0]
    rows = dict(zip(("image", "diffuser"), np.median(drawn, axis=0), strict=True))

    def shown() -> str:
        return drawn_map("erased share", shares, "domain", rows)

    assert rows["diffuser"][1] < 0.8, shown()
    assert rows["image"][1] > 1.2, shown()
    assert rows["image"][0] > rows["diffuser"][1], shown()


def test_smooth_diffusers_and_regular_lenslets_fail_earlier_as_photons_fall(drawn_map: DrawnMap) -> None:
    """Kuo 2020, Fig. 6.3: at equal light in the brightest pixel, which is kind to the smooth one."""
    light = (10.0, 30.0, 90.0, 270.0)
    rows = {}
    for optics in ("regular", "smooth", "random"):
        severities = [
            [
                worst(
                    run_scene(
                        replace(POINTS, seed=7 + k, photons=e, optics=optics), "admm l1", Options(), "quick"
                    ).severities
                )[0]
                for e in light
            ]
            for k in range(3)
        ]
        rows[optics] = np.median(severities, axis=0)

    def shown() -> str:
        return drawn_map("electrons", light, "optics", rows)

    needed = {
        name: next(iter(boundary(light, (0.0,), row[None], logarithmic=True)), (np.inf, 0))[0]
        for name, row in rows.items()
    }
    assert rows["random"][-1] < 1, shown()
    assert needed["smooth"] > 1.3 * needed["random"], shown()
    assert needed["regular"] > 2 * needed["random"], shown()


BOUNDARIES = [
    ("light-points", "admm l1", (5, 15, 45, 135), 1, 19.0, 2.0),
    ("drift", "admm tv", (1, 3, 5, 8), 0.001, 5.2, 1.5),
    ("depth-error", "admm l1", (2, 4, 6, 9), 3000, 4.6, 1.5),
    ("background", "admm tv", (1, 10, 40), 1000, 19.0, 2.2),
    ("density-voxels", "admm l1 of volumes", (0.001, 0.003, 0.01, 0.03), 4, 0.0073, 1.5),
    ("mask-moved", "4 mask pixels an SLM pixel", (0.1, 0.25, 0.5, 1), 0.0, 0.32, 1.5),
    ("mask-defocus", "16 mask pixels an SLM pixel", (10, 25, 50, 100), 0.0, 28.0, 1.6),
]
"""Map, method, where along x, at which y, boundary on 2026-11-22, factor by which it may move."""


@pytest.mark.parametrize(("name", "method", "x", "y", "expected", "factor"), BOUNDARIES)
def test_the_maps_boundaries_have_not_moved(
    name: str,
    method: str,
    x: tuple[float, ...],
    y: float,
    expected: float,
    factor: float,
    drawn_map: DrawnMap,
) -> None:
    stress = map_named(name)
    row = [worst(stress.trial(method, v, y, 0, "quick").severities)[0] for v in x]

    def shown() -> str:
        return drawn_map(stress.x.label, x, stress.y.label, {f"{y:g} {stress.y.unit}": row})

    crossing = boundary(x, (y,), np.array([row]), logarithmic=True)
    assert crossing, shown()
    assert expected / factor < crossing[0][0] < expected * factor, f"{crossing[0][0]:.3g}\n{shown()}"
