"""Wrong calibrations are named, right ones are not, and where nobody can tell that is said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from recon import Calibration, Geometry, reconstruct
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.camera.transformed import Transformation, transformed
from recon.errors import InputError
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.optics.diffuser import smooth_diffuser
from recon.optics.fall_off import gaussian_fall_off
from recon.optics.grid import GREEN, PixelGrid
from recon.optics.render import render
from recon.optics.scene import bar_target, picture
from recon.optics.wave import WavePropagator
from recon.reconstruction import decoys
from recon.reconstruction.decoys import check_calibration
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions as Options
from recon.reconstruction.pilot import pilot
from recon.reconstruction.problem import Problem
from recon.reconstruction.selection import choose
from recon.verdict.calibration_check import (
    BETWEEN,
    FAR,
    GIVEN,
    CalibrationCheck,
    Fit,
    Score,
    check_of,
    near_decoys,
)
from recon.verdict.coded import Coded, coded
from recon.verdict.judge import Region, Verdict
from tests.golden import inputs

GRID = PixelGrid((96, 96), 13.0)
D_UM, Z_UM = 8900.0, 150e3


@pytest.fixture(scope="module")
def seen() -> tuple[Float32Array, Float32Array]:
    """A photograph of bars and the PSF, by propagation, with shot and read noise."""
    rng = np.random.default_rng(1)
    optics = WavePropagator(smooth_diffuser((880.0, 880.0), 5.0, seed=1), D_UM)
    psf = optics.psf((0.0, 0.0, Z_UM), GRID, GREEN.samples(1)) * 1.0
    psf *= 20_000 / psf.max()
    scene = picture(bar_target(128), Z_UM, 0.7 * 96 * 13.0 * Z_UM / D_UM)
    light = render(
        scene, (0.0, 1.0, 0.0), GRID, optics, gaussian_fall_off(20.0), layer_photons=1, bead_photons=1
    )
    light = light * 8000 / light.max()
    noisy = [np.maximum(rng.poisson(i) + rng.normal(0, 3, i.shape), 0) for i in (light, psf)]
    return noisy[0].astype(np.float32), noisy[1].astype(np.float32)


def fit(photograph: Float32Array, psf: Float32Array) -> tuple[Fit, str]:
    check = check_calibration(Problem.of(photograph, psf))
    assert check is not None
    return check.fit, str(check.better)


def test_a_right_calibration_fits(seen: tuple[Float32Array, Float32Array]) -> None:
    assert fit(*seen)[0] is Fit.FITS
    moved = transformed(seen[1], Transformation(5, -3))
    assert fit(seen[0], moved)[0] is Fit.FITS  # the picture is displaced, and nobody can tell


@pytest.mark.parametrize(
    ("how", "found"),
    [
        (Transformation(rotation_deg=1), "turned by -1 degrees"),
        (Transformation(scale=0.985), "1.2 % larger"),
        (Transformation(mirrored=True), "mirrored"),
        (Transformation(rotation_deg=180), "turned by +180 degrees"),
    ],
)
def test_what_became_of_a_wrong_one_is_named(
    seen: tuple[Float32Array, Float32Array], how: Transformation, found: str
) -> None:
    assert fit(seen[0], transformed(seen[1], how)) == (Fit.OFF, found)


def test_another_diffusers_is_foreign_and_never_reliable(seen: tuple[Float32Array, Float32Array]) -> None:
    optics = WavePropagator(smooth_diffuser((880.0, 880.0), 5.0, seed=2), D_UM)
    other = optics.psf((0.0, 0.0, Z_UM), GRID, GREEN.samples(1))
    result = reconstruct(seen[0], other, iterations=20)
    assert result.verdict is not None
    assert result.verdict.region is Region.OUTSIDE
    first, *_ = result.verdict.sentences
    assert first.startswith("not reliable: the calibration does not")


def test_where_nothing_is_lit_or_all_is_nothing_is_told(seen: tuple[Float32Array, Float32Array]) -> None:
    for wall in (1000, 4000):
        noise = np.random.default_rng(3).normal(wall, 30, seen[0].shape).astype(np.float32)
        assert fit(noise, seen[1])[0] is Fit.UNTOLD


def test_a_photograph_mostly_at_full_scale_has_its_noise_and_accuses_nobody(
    seen: tuple[Float32Array, Float32Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    clipped = np.minimum(seen[0], np.percentile(seen[0], 40))
    assert Problem.of(clipped, seen[1]).noise[0] > 0.3 * Problem.of(*seen).noise[0]
    scores = GOOD | {FAR[0]: BETTER}
    for accused in (
        CalibrationCheck(Fit.OFF, scores, 9000, FAR[0]),
        CalibrationCheck(Fit.FOREIGN, GOOD, 9000),
    ):
        monkeypatch.setattr(decoys, "_competition", lambda *_, accused=accused: accused)
        assert [fit(image, seen[1])[0] for image in (seen[0], clipped)] == [accused.fit, Fit.UNTOLD]
        calibration = Calibration(seen[1][None, None], np.full((1, 3), np.nan))
        without = Problem.of(Measurement(clipped, erasures=clipped == clipped.max()), calibration)
        for problem in (without, choose(without)):  # which has forgotten what it left out
            check = check_calibration(problem)
            assert check is not None
            assert check.fit is Fit.UNTOLD


def test_no_copy_of_a_smooth_psf_is_so_small_that_nothing_is_left_of_it() -> None:
    """A hill is its own mirror image: its few decoys left room for sizes of a fourth and less."""
    rows, columns = (np.linspace(-1, 1, n) for n in (75, 100))
    hill = np.exp(-(rows[:, None] ** 2 + columns**2) / 0.1).astype(np.float32)
    narrow = np.exp(-(rows[:, None] ** 2 + columns**2) / 0.04).astype(np.float32)
    photograph = np.random.default_rng(2).poisson(2e4 * narrow + 20).astype(np.float32)
    check = check_calibration(Problem.of(photograph, hill))
    assert check is not None
    assert all(
        0.7 < how.scale < 1.4 and abs(how.rotation_deg) <= 20 for how in check.scores if how not in FAR
    )


@pytest.mark.parametrize("said", decoys.CONTRADICTIONS)
def test_what_contradicts_itself_is_not_told(
    seen: tuple[Float32Array, Float32Array], monkeypatch: pytest.MonkeyPatch, said: tuple[Fit, Fit]
) -> None:
    unsure = GOOD | dict.fromkeys(NEAR, GOOD[GIVEN])  # else the first would do
    told = iter([CalibrationCheck(fit, unsure, 9000, NEAR[0]) for fit in said])
    monkeypatch.setattr(decoys, "_competition", lambda *_: next(told))
    assert fit(*seen) == (Fit.UNTOLD, "None")


def test_a_saturated_psf_is_named_as_what_does_not_fit(
    seen: tuple[Float32Array, Float32Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    unsure = dict.fromkeys((GIVEN, *NEAR, *FAR), GOOD[GIVEN])
    clipped = np.minimum(seen[1], np.percentile(seen[1], 95))
    for better, named in ((NEAR[0], "PSF is saturated"), (FAR[0], "mirrored")):
        off = CalibrationCheck(Fit.OFF, unsure | {better: BETTER}, 9000, better)
        monkeypatch.setattr(decoys, "_competition", lambda *_, off=off: off)
        check = check_calibration(Problem.of(seen[0], clipped))
        assert check is not None
        assert named in check.sentences[0]


@pytest.mark.parametrize("both", [False, True])
def test_files_that_are_not_in_proportion_to_the_light_are_named(
    seen: tuple[Float32Array, Float32Array], monkeypatch: pytest.MonkeyPatch, both: bool
) -> None:
    unsure = dict.fromkeys((GIVEN, *NEAR, *FAR), GOOD[GIVEN]) | {NEAR[0]: BETTER}
    monkeypatch.setattr(decoys, "_competition", lambda *_: CalibrationCheck(Fit.OFF, unsure, 9000, NEAR[0]))
    photograph, psf = (255 * (image / image.max()) ** (1 / 2.2) for image in seen)
    coded = check_calibration(Problem.of(photograph, psf if both else seen[1]))
    turned = check_calibration(Problem.of(seen[0], transformed(seen[1], Transformation(rotation_deg=1))))
    assert coded is not None
    assert turned is not None
    assert ("both are" if both else "the photograph is") + " gamma-coded" in coded.sentences[0]
    assert turned.cause is None


def test_bright_points_in_proportion_to_the_light_are_not_named_so() -> None:
    rng = np.random.default_rng(0)
    rough = gaussian_filter(rng.normal(size=(96, 96)), 1.5)
    rough = np.exp(1.6 * rough / rough.std()) * np.outer(np.hanning(96), np.hanning(96))
    psf = (20_000 * rough / rough.max()).astype(np.float32)
    light = sum(
        rng.uniform(0.3, 1) * np.roll(psf, rng.integers(-20, 20, 2), (0, 1)) for _ in range(5)
    )  # raised to a power, a few points are explained better by nearly any PSF
    photograph = rng.poisson(3000 * light / light.max()).astype(np.float32)
    check = check_calibration(Problem.of(photograph, transformed(psf, Transformation(rotation_deg=1))))
    assert check is not None
    assert check.fit is Fit.OFF
    assert check.cause is None


def test_noise_thought_to_be_less_than_it_is_makes_nobody_foreign() -> None:
    noisy = {how: score(1.22, 1.33, 0.001) for how in (GIVEN, *NEAR, *FAR)}
    assert check_of(noisy, 9000, structure=0.35).fit is Fit.UNTOLD  # of which any PSF explains 0.13
    assert check_of(noisy, 9000, structure=0.5).fit is Fit.FOREIGN


def test_of_a_picture_with_a_background(seen: tuple[Float32Array, Float32Array]) -> None:
    stray = np.random.default_rng(4).poisson(2 * seen[0].mean() * np.linspace(0.7, 1.3, 96), (96, 96))
    problem = Problem.of(seen[0] + stray.astype(np.float32), seen[1], Options(estimate_background=True))
    found = pilot(problem, 10)
    assert found.background is not None
    assert np.linalg.norm(found.left) == pytest.approx(found.outcome.history[-1].data_residual, rel=0.1)
    turned = Problem.of(
        problem.measurement, transformed(seen[1], Transformation(rotation_deg=1)), problem.options
    )
    right, wrong = check_calibration(problem), check_calibration(turned)
    assert [right and right.fit, wrong and str(wrong.better)] == [Fit.FITS, "turned by -1 degrees"]


@pytest.mark.parametrize(
    ("gain", "scale", "found"),
    [
        (-0.1, 1.04, Fit.OFF),
        (0.0, 1.04, Fit.UNTOLD),  # of what stray light alone explains nobody is accused
        (0.0, 1.08, Fit.OFF),  # but such a size is no own one's that moved
        (0.5, 1.04, Fit.FITS),
    ],
)
def test_an_accused_one_is_cleared_against_its_accuser_wherever_that_was_tried(
    seen: tuple[Float32Array, Float32Array],
    monkeypatch: pytest.MonkeyPatch,
    gain: float,
    scale: float,
    found: Fit,
) -> None:
    on_the_way, right = Transformation(scale=scale), GOOD[GIVEN]
    accused = CalibrationCheck(Fit.OFF, GOOD, 9000, on_the_way)
    told = iter((accused, accused, CalibrationCheck(Fit.FITS, GOOD, 9000)))
    monkeypatch.setattr(decoys, "_competition", lambda *_: next(told))
    accuser = score(1.2, right.objective + gain, 0.001)
    monkeypatch.setattr(decoys._Small, "score", lambda *_, **__: accuser)
    assert fit(*seen)[0] is found


def test_volumes_are_told_by_turns(seen: tuple[Float32Array, Float32Array]) -> None:
    psfs = np.stack([seen[1], transformed(seen[1], Transformation(scale=1.1))])[:, None]
    depths = Calibration(psfs, np.array([[0.0, 0.0, Z_UM], [0.0, 0.0, 0.6 * Z_UM]]))
    right = check_calibration(Problem.of(seen[0], depths))
    assert right is not None
    assert right.fit is Fit.FITS
    assert not any(how.scale != 1 for how in right.scores)


@pytest.mark.parametrize("stretch", [0.2, 0.5])
def test_psfs_that_vary_much_over_the_field_are_told_by_all_of_them(stretch: float) -> None:
    grid = inputs.over_field(stretch=stretch)
    own = Calibration(grid["psfs"], grid["positions_um"], geometry=Geometry(10.0, 5.0))
    mirrored = replace(own, psfs=np.ascontiguousarray(own.psfs[..., ::-1]))
    photograph = inputs.beads(1, stretch=stretch)
    right, wrong = (
        check_calibration(Problem.of(photograph, psfs, Options(estimate_background=True)))
        for psfs in (own, mirrored)
    )
    assert [right and right.fit is Fit.FITS, wrong and wrong.wrong] == [True, True]


NEAR = near_decoys((160, 160), sizes=True)
TILES = 1 + 0.01 * np.random.default_rng(0).normal(size=16)


def score(misfit: float, objective: float, unlike: float = 0.0) -> Score:
    """Return a score in tiles that differ."""
    tiles = TILES + unlike * TILES[::-1]
    return Score(misfit, objective, tuple(misfit * tiles), tuple(objective * tiles))


BETTER = score(1.1, 1.4, 0.001)
GOOD = {GIVEN: score(1.2, 1.5), BETWEEN: score(1.2, 1.5)} | {how: score(1.6, 2.0, 0.1) for how in NEAR}


@pytest.mark.parametrize(
    ("first", "heavier", "left", "said"),
    [
        (Fit.UNTOLD, Fit.FITS, 40.0, Fit.FITS),
        (Fit.UNTOLD, Fit.FITS, 4.0, Fit.UNTOLD),  # as noise: the weight is right already
        (Fit.UNTOLD, Fit.OFF, 40.0, Fit.OFF),
        (Fit.FOREIGN, Fit.OFF, 40.0, Fit.OFF),
        (Fit.FOREIGN, Fit.FITS, 40.0, Fit.FOREIGN),
    ],
)
def test_where_far_more_than_noise_is_left_it_sets_the_priors_weight(
    seen: tuple[Float32Array, Float32Array],
    monkeypatch: pytest.MonkeyPatch,
    first: Fit,
    heavier: Fit,
    left: float,
    said: Fit,
) -> None:
    scores = dict.fromkeys((GIVEN, *NEAR, *FAR), score(left, left)) | {NEAR[0]: score(left - 1, left - 1)}
    weights: list[float] = []

    def scored_with(_problem: Problem, _iterations: int, weight: float) -> Score:
        weights.append(weight)
        return scores[GIVEN]

    def competed(_: object, scored: Callable[[Transformation], Score]) -> CalibrationCheck:
        scored(GIVEN)
        fit = heavier if weights[-1] != decoys.WEIGHT else first
        return CalibrationCheck(fit, scores, 9000, NEAR[0] if fit is Fit.OFF else None)

    monkeypatch.setattr(decoys, "_competition", competed)
    monkeypatch.setattr(decoys, "_score", scored_with)
    check = check_calibration(Problem.of(*seen))
    assert check is not None
    assert check.fit is said
    assert weights[-1] == pytest.approx(max(1.0, left**0.5) if left > 9 else decoys.WEIGHT, rel=0.01)


@pytest.mark.parametrize("turned_deg", [0, 1])
def test_the_measured_targets_own_calibration_fits_at_full_size(turned_deg: float) -> None:
    if not (data_folder() / "diffusercam_usaf3d").is_dir():
        pytest.skip("the measured USAF set is not here (DIFFUSERBENCH_DATA)")
    psfs, photograph = measured_set("usaf")
    psfs = transformed(psfs[::8], Transformation(rotation_deg=turned_deg))
    calibration = Calibration(psfs[:, None], np.full((len(psfs), 3), np.nan))
    check = check_calibration(Problem.of(photograph, calibration))
    assert check is not None
    assert (check.fit, str(check.better)) == (
        (Fit.OFF, "turned by -1 degrees") if turned_deg else (Fit.FITS, "None")
    )


def test_without_a_far_decoy_the_near_ones_tell() -> None:
    assert check_of(GOOD, 10_000).fit is Fit.FITS
    assert check_of(GOOD | {NEAR[0]: score(1.1, 1.4, 0.001)}, 10_000).better == NEAR[0]


def test_a_pattern_that_is_half_its_own_mirror_image_is_not_foreign() -> None:
    given, worse, much = score(3.0, 4.0), score(3.0, 4.02, 0.2), score(3.3, 4.5, 0.2)
    scores = dict.fromkeys(NEAR, worse) | {GIVEN: given, FAR[0]: much, FAR[1]: much, FAR[2]: score(3.0, 4.0)}
    assert check_of(scores, 9000, structure=8.0).fit is Fit.UNTOLD
    assert check_of(scores | {FAR[1]: worse}, 9000, structure=8.0).fit is Fit.FOREIGN
    better = score(2.9, 3.9)
    assert check_of(scores | {FAR[2]: better}, 900, structure=8.0).fit is not Fit.UNTOLD


def test_on_the_same_pixels_more_iterations_tell_who_is_foreign(
    seen: tuple[Float32Array, Float32Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    unsure = dict.fromkeys((GIVEN, *NEAR, *FAR), GOOD[GIVEN])
    told = iter([CalibrationCheck(f, unsure, 9000) for f in (Fit.FOREIGN, Fit.UNTOLD)])
    monkeypatch.setattr(decoys, "_competition", lambda *_: next(told))
    assert fit(*seen)[0] is Fit.UNTOLD  # 96 x 96 pixels: the thorough way has no more


def test_differences_within_the_noise_accuse_nobody() -> None:
    far = {how: score(40.0, 45.0, 0.1) for how in FAR}
    assert check_of(GOOD | far | {NEAR[0]: score(1.2, 1.4999)}, 10_000).fit is Fit.FITS


def test_an_untold_calibration_is_doubtful_at_best() -> None:
    alike = {how: score(1.2, 1.5) for how in (*NEAR, *FAR)}
    check = check_of(GOOD | alike, 10_000)
    assert check.fit is Fit.UNTOLD
    good = Verdict(Region.INSIDE, "admm tv", 0.0, ()).with_calibration(check)
    assert good.region is Region.NEAR
    assert good.sentences == (
        "doubtful: the photograph does not tell whether the calibration is its own: any PSF would explain it "
        "as well.",
    )


def test_swapped_and_identical_images_are_refused_before_the_work(
    seen: tuple[Float32Array, Float32Array],
) -> None:
    photograph, psf = seen
    with pytest.raises(InputError, match="seem to be swapped"):
        reconstruct(psf, photograph)
    with pytest.raises(InputError, match="are the same image: give the photograph of the scene"):
        reconstruct(psf + 40, psf)
    with pytest.raises(InputError, match="are the same image"):
        reconstruct(psf, psf, erasures=psf > 15_000)
    point = np.random.default_rng(2).poisson(psf).astype(np.float32)
    assert reconstruct(point, psf, iterations=2, judged=False).is_picture  # a point's photograph is none


@pytest.mark.parametrize(("misfit", "said"), [(20.0, False), (80.0, True)])
def test_where_the_better_copy_explains_little_more_it_may_be_anothers(misfit: float, said: bool) -> None:
    turned = Transformation(rotation_deg=-2.0)
    scores = {how: Score(m, m, (m,), (m,)) for how, m in ((GIVEN, 100.0), (turned, misfit))}
    _, what_to_do = CalibrationCheck(Fit.OFF, scores, 1000, turned).sentences
    assert ("another diffuser's" in what_to_do) is said


def coded_for_the_eye(image: Float32Array) -> Float32Array:
    """Return 8 bit such as a camera writes for the eye, binned, less their darkest."""
    coded = block_mean(np.round(255 * (np.maximum(image, 0) / image.max()) ** (1 / 2.2)), 8)
    return np.asarray(coded - coded.min(), np.float32)


@pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the hand is not in {data_folder()}"
)
@pytest.mark.parametrize("is_coded", [False, True])
def test_a_measured_photograph_that_is_coded_is_named_though_its_own_psf_wins(is_coded: bool) -> None:
    psfs, photograph = measured_set("hand")
    photograph = coded_for_the_eye(photograph) if is_coded else block_mean(photograph, 8)
    check = check_calibration(choose(Problem.of(photograph, block_mean(psfs[0], 8))))
    assert check is not None
    assert check.fit is (Fit.OFF if is_coded else Fit.FITS)
    if is_coded:
        assert "the photograph is gamma-coded" in check.sentences[0]
        assert "--srgb photograph" in check.sentences[1]


@pytest.mark.skipif(
    not (data_folder() / "diffusercam_hand").is_dir(), reason=f"the hand is not in {data_folder()}"
)
@pytest.mark.parametrize("is_coded", [False, True])
def test_a_background_is_no_code_and_what_is_coded_under_even_light_is(is_coded: bool) -> None:
    psfs, photograph = measured_set("hand")
    if is_coded:
        lit = np.maximum(photograph + 0.5 * photograph.mean(), 0)
        seen = block_mean(np.round(255 * (lit / lit.max()) ** (1 / 2.2)), 8)
    else:  # a thousandth of the counts on a dark level that was not taken off
        noise = 0.25 * np.random.default_rng(1).standard_normal(block_mean(photograph, 8).shape)
        seen = block_mean(photograph, 8) * 0.001 + 70 + noise
    problem = choose(Problem.of(seen.astype(np.float32), block_mean(psfs[0], 8)))
    assert problem.smooth
    check = check_calibration(problem)
    assert check is not None
    assert check.fit is (Fit.OFF if is_coded else Fit.FITS)
    assert (check.cause is not None and "gamma-coded" in check.cause[0]) is is_coded


def test_a_psf_alone_is_not_called_coded_as_a_power_takes_a_pedestal_too() -> None:
    photograph, psfs = np.eye(4, dtype=np.float32), np.full((1, 1, 4, 4), 0.5, np.float32)
    psfs[..., 0, 0] = 1

    def left(seen: Float32Array, response: Float32Array) -> float:
        return 0.1 if seen is photograph and response is not psfs else 0.3

    assert coded(photograph, psfs, left, asked=True) is None


@pytest.mark.parametrize("n_depths", [1, 2])
def test_a_volume_is_offered_what_straightens_its_files(
    seen: tuple[Float32Array, Float32Array], monkeypatch: pytest.MonkeyPatch, n_depths: int
) -> None:
    photograph, psf = seen
    psfs = np.stack([psf, transformed(psf, Transformation(scale=1.2))])[:n_depths, None]
    places = np.array([(0, 0, Z_UM), (0, 0, 2 * Z_UM)])[:n_depths]
    # Mirrored; as it is over a background, which volumes have estimated; straightened.
    left = iter((0.8, 0.2) if n_depths == 1 else (0.8, 0.8, 0.2))
    monkeypatch.setattr(decoys, "coded", lambda *_, **__: Coded(psf=False))
    monkeypatch.setattr(decoys._Small, "unexplained", lambda *_, **__: next(left))
    problem = Problem.of(photograph, Calibration(psfs.astype(np.float32), places))
    cause = decoys._cause(problem, FAR[0])
    assert cause is not None
    assert "the photograph is gamma-coded" in cause[0]
    assert "--srgb photograph" in cause[1]


@pytest.mark.parametrize(("pixels", "explained"), [(100, True), (160, False)])
def test_what_is_left_is_held_against_the_contrast_of_the_same_pixels(
    seen: tuple[Float32Array, Float32Array], monkeypatch: pytest.MonkeyPatch, pixels: int, explained: bool
) -> None:
    """Larger pixels have less noise, so that the same contrast is more of it there."""

    def small(_: Problem, longest_px: int) -> SimpleNamespace:
        data = np.array([1.0, -1.0]) * (10.0 if longest_px == 100 else 5.0)
        of_it = SimpleNamespace(data=data, valid=np.ones(2, bool))
        return SimpleNamespace(pixels=longest_px, seen=lambda background: of_it)

    monkeypatch.setattr(decoys, "_small", small)
    left = Score(1.25, 1.0, (1.0,), (1.0,))  # half of the noise beyond it: 5 % of a contrast of 10, 10 % of 5
    check = CalibrationCheck(Fit.FITS, {GIVEN: left}, pixels)
    assert decoys._is_explained(check, Problem.of(*seen)) is explained
