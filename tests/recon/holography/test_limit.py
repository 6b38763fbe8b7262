"""The limit: a true bound, held against dense matrices and against many frames."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import (
    DcTerm,
    Display,
    Hologram,
    HologramModel,
    HologramOptions,
    HologramRecord,
    HologramStop,
    Target,
    compute_hologram,
    hologram_limit,
    random_mask,
)
from recon.holography.learn import nothing_learned
from recon.holography.limit import (
    COLUMNS,
    DENSE,
    FAR_DB,
    STEPS,
    _below_least,
    _gap,
    gain_of_frames,
    limited_by,
)

SHAPE, K = (12, 16), 4


def picture():
    y, x = np.mgrid[0 : 1 : SHAPE[0] * K * 1j, 0 : 1 : SHAPE[1] * K * 1j]
    return np.where((y - 0.5) ** 2 + (x - 0.4) ** 2 < 0.08, 1.0, 0.05 + 0.1 * x)


@pytest.mark.parametrize("dc", [0.0, 0.1])
def test_no_number_of_frames_passes_the_bound(dc):
    display = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=2), dc=DcTerm(dc, 0.6))
    limit = hologram_limit(display, Target(picture(), white=1.0), HologramOptions(iterations=150))
    assert limit.reached_db <= limit.bound_db < limit.reached_db + 0.5
    for frames in (1, 8):
        model = HologramModel(display, [Target(picture(), white=1.0)], frames=frames)
        shown = compute_hologram(model, iterations=150).history[-1].psnr_db
        assert shown < limit.bound_db
    assert shown > limit.bound_db - 2
    assert limit.wanted.max() > 0.5
    assert 0 <= limit.reached.min() <= limit.reached.max() <= 1


@pytest.mark.parametrize("dc", [0.0, 0.2])
def test_the_gap_is_that_of_the_dense_matrix_and_bounds_the_loss_of_other_matrices(dc):
    shape = (6, 5)
    display = Display(shape, random_mask((12, 10), seed=1), dc=DcTerm(dc, 0.4))
    target = [Target(np.random.default_rng(0).random((12, 12)))]
    model = HologramModel(display, target, frames=COLUMNS)
    rng = np.random.default_rng(3)

    def rows():
        z = rng.normal(size=(COLUMNS, *shape)) + 1j * rng.normal(size=(COLUMNS, *shape))
        return np.asarray(z / np.sqrt(np.mean(np.abs(z) ** 2, axis=0)), np.complex64)

    slm = rows()
    found = model.evaluate(slm)
    gap = _gap(model, slm, found.gradient)
    n = slm[0].size
    single = HologramModel(display, target)
    model.evaluate(slm)
    slope = model.slope()
    alpha, light = display.dc.modulated, display.dc.amplitude
    into = np.vstack([alpha * np.eye(n), np.full((1, n), light)]).T  # unmodulated light is one more row
    columns = [single.weighed(np.eye(n)[i].reshape(shape), slope).ravel() for i in range(n)]
    dense = into.conj().T @ np.array(columns).T @ into
    whole = np.vstack([slm.reshape(COLUMNS, n).T, np.ones((1, COLUMNS))]) / np.sqrt(COLUMNS)
    y = np.sum((whole.conj() * (dense @ whole)).real, axis=1)
    least = np.linalg.eigvalsh(dense - np.diag(y))[0]
    assert gap == pytest.approx(-(n + 1) * least, rel=0.03)
    for _ in range(5):
        assert model.evaluate(rows()).loss >= found.loss - gap


def test_no_eigenvalue_is_below_what_lanczos_tells_even_where_the_least_is_alone_and_near_others():
    for few in (np.array([-1.0]), np.array([-1.0, -0.99, -0.98])):
        values = np.concatenate([few, np.linspace(-0.97, 3.0, DENSE)]).astype(np.float32)
        assert -1.1 < _below_least(lambda x, values=values: values * x, len(values)) <= -1.0
    # Lanczos ends at once where all eigenvalues are one.
    assert _below_least(lambda x: -x, DENSE + 1) == pytest.approx(-1.0, abs=1e-4)


def test_few_eigenvalues_far_above_do_not_blur_the_least():
    n = 20000
    rng = np.random.default_rng(0)
    values = np.sort(rng.uniform(-1.0, 60.0, n))
    values[:3], values[-3:] = (-2.0, -1.9, -1.8), (9e3, 1.5e4, 2e4)
    values = values.astype(np.float32)
    steps = []

    def apply(x):
        steps.append(1)
        return values * x

    assert -2.3 < _below_least(apply, n) <= -2.0
    assert len(steps) < STEPS


def test_it_can_be_interrupted_and_is_a_bound_all_the_same():
    display = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=2))
    stop = threading.Event()
    early = hologram_limit(display, Target(picture(), white=1.0), callback=lambda *_: stop.set(), cancel=stop)
    assert early.stop_reason is HologramStop.CANCELLED
    assert early.bound_db > hologram_limit(display, Target(picture(), white=1.0)).reached_db
    with pytest.raises(InputError, match="loss 'frequency'"):
        hologram_limit(display, Target(picture()), HologramOptions(loss="none"))
    with pytest.raises(InputError, match="learned from photographs"):
        hologram_limit(display.taught(nothing_learned(display)), Target(picture()))


def hologram(*psnr_db: float, reason: HologramStop = HologramStop.ITERATIONS) -> Hologram:
    history = tuple(HologramRecord(n, 0.0, 1.0, value) for n, value in enumerate(psnr_db))
    return Hologram(np.ones((1, *SHAPE), np.complex64), history, reason, 0.0)


def test_a_search_goes_on_from_a_like_target_and_ends_where_nothing_limits():
    display = Display(SHAPE, random_mask((SHAPE[0] * K, SHAPE[1] * K), seed=2))
    first = hologram_limit(display, Target(picture(), white=1.0))
    steps = []
    again = hologram_limit(
        display, Target(picture(), white=1.0), initial=first.columns, callback=lambda *_: steps.append(1)
    )
    assert len(steps) <= 6
    assert again.bound_db == pytest.approx(first.bound_db, abs=0.1)
    easy = hologram_limit(display, Target(np.full((48, 64), 0.5) + 0.01 * picture(), white=1.0))
    assert easy.bound_db == np.inf
    assert easy.reached_db >= FAR_DB
    assert easy.stop_reason is HologramStop.QUALITY


@pytest.mark.parametrize(
    ("background", "factor", "limits"), [(0.0, 6, "contrast"), (0.3, 2, "frames"), (0.0, 1, "frames")]
)
def test_what_a_picture_lacks_is_frames_or_contrast(background, factor, limits):
    shape = (28, 36)
    display = Display(shape, random_mask((shape[0] * factor, shape[1] * factor), seed=1))
    image = np.full((64, 64), background)
    image[28:34, 20:40] = 1.0
    words = limited_by(display, [Target(image)], hologram(1, 2, 2.1, 2.2, 2.3, 2.4), HologramOptions(), 0.6)
    assert [line.partition(":")[0] for line in words] == [limits, *(["alignment"] if factor > 1 else [])]
    if limits == "frames":
        assert gain_of_frames(display, [Target(image)], HologramOptions()) > gain_of_frames(
            display, [Target(image)], HologramOptions(frames=4)
        )


def test_what_rounding_to_few_phases_costs_is_told():
    display, image = Display(SHAPE, random_mask((SHAPE[0] * 2, SHAPE[1] * 2), seed=1)), picture()
    for levels, told in ((4, True), (200, False), (None, False)):
        options = HologramOptions(phase_levels=levels, iterations=20)
        found = compute_hologram(HologramModel(display, [Target(image)], options))
        words = limited_by(display, [Target(image)], found, options, 0.6)
        assert any(line.startswith(f"levels: rounded to {levels} phases it lost") for line in words) is told


def test_search_light_and_alignment_are_told_where_they_limit():
    display = replace(
        Display(SHAPE, random_mask((SHAPE[0] * 2, SHAPE[1] * 2), seed=1)),
        displacement=np.zeros((2, 2, 2)),
        lost_db=0.8,
    )
    options = HologramOptions(complex_slm=True)
    words = limited_by(display, [Target(picture())], hologram(1, 2, 3, 4, 5, 6), options, 0.06)
    assert [line.partition(":")[0] for line in words] == ["search", "light", "alignment"]
    assert "0.8 dB" in words[-1]
    settled = hologram(1, 2, 3, 4, 5, 6, reason=HologramStop.CONVERGED)
    assert limited_by(replace(display, lost_db=0.1), [Target(picture())], settled, options, 0.5) == ()


@pytest.mark.parametrize(
    ("psnr_db", "told"), [((34, 34, 34), ["contrast"]), ((36, 36, 36), []), ((1, 12, 20), ["search"])]
)
def test_contrast_is_told_neither_of_a_good_hologram_nor_of_one_still_searching(monkeypatch, psnr_db, told):
    monkeypatch.setattr("recon.holography.limit.gain_of_frames", lambda *_: 1.0)
    display = Display(SHAPE, random_mask(SHAPE, seed=1))
    words = limited_by(display, [Target(picture())], hologram(*psnr_db), HologramOptions(), 0.6)
    assert [line.partition(":")[0] for line in words] == told


def test_what_frames_gain_planes_is_told_from_a_part_with_the_planes_farther_apart(monkeypatch):
    display = Display((48, 64), random_mask((96, 128), seed=1), slm_pitch_um=8.0, focal_mm=35.0)
    planes = [Target(picture()), Target(picture()[::-1, ::-1].copy(), 8.0)]
    whole = gain_of_frames(display, planes, HologramOptions())
    seen = []

    def watched(display, targets, *rest, **more):
        seen.append((display.slm_shape, [target.z_mm for target in targets]))
        return HologramModel(display, targets, *rest, **more)

    monkeypatch.setattr("recon.holography.limit.HologramModel", watched)
    monkeypatch.setattr("recon.holography.limit.SMALL_DEEP", 48 * 64 // 4)
    part = gain_of_frames(display, planes, HologramOptions())
    assert seen[0] == ((24, 32), [0.0, 32.0])
    assert 0 < part == pytest.approx(whole, abs=3.0)
    assert np.isnan(gain_of_frames(replace(display, distance_mm=500.0), planes, HologramOptions()))
    monkeypatch.setattr("recon.holography.limit.MOST_DEEP", 10)
    far = [planes[0], replace(planes[1], z_mm=200.0)]
    assert np.isnan(gain_of_frames(display, far, HologramOptions()))
