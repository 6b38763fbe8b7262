"""Light from farther away than any calibrated depth: planes of its own, which are no part of the volume."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.camera.convolution import Convolution
from recon.camera.registration import rescaled
from recon.errors import InputError
from recon.evaluation.measured_sets import data_folder, measured_set
from recon.evaluation.scene import TestScene, make_scene
from recon.reconstruction.background import VOLUME, Trial, beyond_of
from recon.reconstruction.options import Overrides, ReconstructionOptions
from recon.reconstruction.planes import BEYOND, with_planes_beyond
from recon.reconstruction.problem import Problem
from recon.reconstruction.selection import choose
from recon.types import Calibration


@pytest.fixture(scope="module")
def beads() -> TestScene:
    return make_scene("beads", size=32, depths=3, density=0.3, photons=2e4, seed=5)


@pytest.fixture(scope="module")
def hazy(beads: TestScene) -> np.ndarray:
    """The beads before an even light as bright, whose patterns are two thirds of the farthest depth's."""
    far = int(np.argmax(beads.calibration.source_positions_um[:, 2]))
    camera = Convolution(rescaled(beads.calibration.psfs[far : far + 1], 1.5), (32, 32))
    y, x = np.indices(camera.domain_shape[2:])
    middle = np.hypot(y - y.max() / 2, x - x.max() / 2) < 6
    light = camera.forward(middle.astype(np.float32)[None, None])[0]
    return np.asarray(beads.measurement + light * (beads.measurement.mean() / light.mean()))


def test_the_farthest_depths_pattern_shrinks_and_keeps_its_light(beads: TestScene) -> None:
    calibration = beads.calibration
    far = int(np.argmax(calibration.source_positions_um[:, 2]))
    added = with_planes_beyond(calibration)
    assert np.array_equal(added.psfs[:3], calibration.psfs)
    assert (np.diff(added.source_positions_um[3:, 2]) > 0).all()
    assert added.psfs[3:].sum(axis=(1, 2, 3)) == pytest.approx(calibration.psfs[far].sum(), rel=0.1)
    blind = replace(calibration, source_positions_um=np.full((3, 3), np.nan))
    np.testing.assert_array_equal(with_planes_beyond(blind).psfs, added.psfs)
    fewer = replace(calibration, psfs=calibration.psfs[:1], source_positions_um=np.zeros((1, 3)))
    np.testing.assert_array_equal(with_planes_beyond(fewer, calibration).psfs[1:], added.psfs[3:])


@pytest.mark.parametrize("prior", ["tv", "nonnegative"])
def test_light_from_beyond_is_found_and_is_background(beads: TestScene, hazy: np.ndarray, prior: str) -> None:
    found = recon.reconstruct(hazy, beads.calibration, prior=prior, iterations=60, judged=False)
    assert found.choice is not None
    assert found.choice.beyond
    assert found.volume.shape == beads.truth.shape
    assert found.background is not None
    assert found.background.min() > -1e-3 * hazy.max()
    assert found.background.mean() == pytest.approx(hazy.mean() / 2, rel=0.4)
    assert "from beyond the farthest calibrated depth" in " ".join(found.warnings)
    (told,) = (d for d in found.choice.decisions if d.name == "beyond")
    assert told.numbers["held_out_with"] ** 2 < told.numbers["held_out_without"] ** 2 - 4


def test_nothing_is_added_where_depths_explain_the_data(beads: TestScene) -> None:
    chosen = choose(Problem.of(beads.measurement, beads.calibration))
    assert chosen.choice is not None
    assert not chosen.choice.beyond
    assert chosen.n_depths == chosen.n_planes == 3


def test_who_asks_for_planes_beyond_gets_them() -> None:
    missed = Trial(without=5.0, lit=1.0, light=0.0, dark=0.0, taken=VOLUME)
    told = beyond_of(missed, missed, Overrides(beyond=True), None)
    assert (told.value, told.overruled) == ("planes", True)
    assert beyond_of(missed, missed, Overrides(), None).value == "none"


def test_depths_and_planes_beyond_are_not_tied(beads: TestScene) -> None:
    options = ReconstructionOptions(prior="tv", choose=Overrides(beyond=True), axis_weights=(0.5, 1.0, 2.0))
    chosen = choose(Problem.of(beads.measurement, beads.calibration, options))
    assert (chosen.n_depths, chosen.n_planes) == (3, 3 + len(BEYOND))
    assert chosen.axis_weights[:, 0].tolist() == [0.5, 0.5, *[0.0] * 7]
    assert (chosen.axis_weights[:, 1:] == (1.0, 2.0)).all()
    alone = Problem.of(beads.measurement, beads.calibration, ReconstructionOptions(prior="tv"))
    assert chosen.energy == pytest.approx(alone.energy, rel=1e-4)


def test_a_volume_to_start_from_has_its_own_depths(beads: TestScene, hazy: np.ndarray) -> None:
    asked = Overrides(beyond=True)
    first = recon.reconstruct(hazy, beads.calibration, prior="l1", choose=asked, iterations=5, judged=False)
    again = recon.reconstruct(
        hazy, beads.calibration, prior="l1", choose=asked, warm=first, iterations=5, judged=False
    )
    assert again.volume.shape == first.volume.shape
    assert again.history[-1].objective < first.history[-1].objective


def test_what_cannot_be_had_is_refused_in_words(beads: TestScene) -> None:
    def asked(prior: str) -> None:
        choose(
            Problem.of(
                beads.measurement,
                beads.calibration,
                ReconstructionOptions(prior=prior, choose=Overrides(beyond=True)),
            )
        )

    with pytest.raises(InputError, match="tv-haar ties depths to one another"):
        asked("tv-haar")


def test_the_measured_targets_light_stands_in_its_own_depths() -> None:
    if not (data_folder() / "diffusercam_usaf3d").is_dir():
        pytest.skip("the measured USAF set is not here (DIFFUSERBENCH_DATA)")
    from recon.base.blocks import block_mean

    psfs, photograph = measured_set("usaf")
    psfs, photograph = (block_mean(a[..., :264, :320], 8) for a in (psfs[::4], photograph))
    calibration = Calibration(psfs[:, None], np.full((len(psfs), 3), np.nan))
    result = recon.reconstruct(photograph, calibration, prior="nonnegative", iterations=60, judged=False)
    assert result.choice is not None
    assert result.choice.beyond
    light = result.volume.sum(axis=(1, 2))
    assert light[-2:].sum() < 0.25 * light.sum()
