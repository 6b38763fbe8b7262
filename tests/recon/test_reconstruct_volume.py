"""Whole reconstructions of volumes, from measurements not made with the reconstruction's model."""

import fcntl
import os
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from recon import Calibration, Geometry, InputError, NoiseModel
from recon import reconstruct as reconstruct_and_judge
from recon.camera.camera_model import choose_model, members_of_depths, sort_by_depth
from recon.solvers import StopReason, memory, tv_admm_volume

reconstruct = partial(reconstruct_and_judge, judged=False)
"""Whether a result can be trusted costs more than such small ones, and is held in tests/recon/verdict."""
SIZE, DEPTHS, SPAN = 40, 8, 0.4
PITCH_UM, DISTANCE_MM = 10.0, 5.0
Z_UM = np.linspace(1 / 8, 1 / 25, DEPTHS) ** -1 * 1000


def render(points, seed=0, size=SIZE, fall_off_px=None):
    """Random lenslets cast one Gaussian spot each of points (y, x, depth, light) at continuous positions."""
    rng = np.random.default_rng(seed)
    lenses = rng.uniform(-0.3, 0.3, (25, 2)) * size
    y, x = np.mgrid[:size, :size] - size // 2
    image = np.zeros((size, size))
    for row, column, depth, light in points:
        m = 1 + SPAN * (1 - depth / (DEPTHS - 1))
        sigma = 0.8 + 0.6 * abs(depth / (DEPTHS - 1) - 0.4)
        # The sensor's response is centred under the source, which is across the axis from its pattern.
        response = (
            1 if fall_off_px is None else np.exp(-((y + row) ** 2 + (x + column) ** 2) / (2 * fall_off_px**2))
        )
        for lens in lenses:
            spot = np.exp(-((y - row - m * lens[0]) ** 2 + (x - column - m * lens[1]) ** 2) / (2 * sigma**2))
            image += response * light / (2 * np.pi * sigma**2) * spot
    return image


def calibration(channels=1, gain=50.0):
    psfs = np.stack([render([(0, 0, z, gain)]) for z in range(DEPTHS)])[:, None]
    psfs = np.repeat(psfs, channels, axis=1).astype(np.float32)
    positions = np.stack([np.zeros(DEPTHS), np.zeros(DEPTHS), Z_UM], axis=1)
    return Calibration(psfs, positions, geometry=Geometry(PITCH_UM, DISTANCE_MM))


BEADS = [(-9.3, 4.6, 2.2, 900.0), (6.4, -7.7, 5.1, 700.0), (2.1, 9.2, 3.6, 800.0)]


def measurement(photons=1.0, seed=1, background=0.0):
    rng = np.random.default_rng(seed)
    return rng.poisson(render(BEADS) * 50 * photons + background).astype(np.float64) + rng.normal(
        0, 2, (SIZE, SIZE)
    )


def where(volume, bead):
    """Depth, row, column of the brightest voxel near a bead's lateral position."""
    row, column = round(bead[0]) + SIZE // 2, round(bead[1]) + SIZE // 2
    near = volume[:, row - 3 : row + 4, column - 3 : column + 4]
    return np.unravel_index(int(near.argmax()), near.shape)


@pytest.mark.parametrize("prior", ["l1", "tv", "tv-isotropic"])
def test_finds_beads_in_space(prior):
    result = reconstruct(measurement(), calibration(), prior=prior)
    assert result.volume.shape == (DEPTHS, SIZE, SIZE)
    assert result.volume.dtype == np.float32
    assert result.model == "convolution"
    for bead in BEADS:
        depth, row, column = where(result.volume, bead)
        assert abs(depth - bead[2]) <= 1.2
        assert abs(row - 3) <= 1
        assert abs(column - 3) <= 1


def test_light_is_kept():
    """With the PSF as calibrated, a bead's voxels sum up to its light."""
    result = reconstruct(
        measurement(), calibration(gain=1.0), prior="l1", tau=1e-3, estimate_background=False
    )
    for y, x, _, light in BEADS:
        row, column = round(y) + SIZE // 2, round(x) + SIZE // 2
        found = result.volume[:, row - 2 : row + 3, column - 2 : column + 3].sum()
        assert found == pytest.approx(50 * light, rel=0.15)


def test_exposure_does_not_change_the_picture():
    b = measurement()
    one = reconstruct(b, calibration(), prior="l1", iterations=60, tolerance=0)
    other = reconstruct(1000 * b, calibration(gain=0.02), prior="l1", iterations=60, tolerance=0)
    np.testing.assert_allclose(other.volume * 4e-7, one.volume, atol=1e-3 * one.volume.max())


def test_background_is_estimated_for_l1():
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    smooth = 3000 * (1 + 0.5 * np.cos(np.pi * x) * np.cos(np.pi * y))
    result = reconstruct(measurement(background=smooth), calibration(), prior="l1")
    assert result.background is not None
    assert np.linalg.norm(result.background - smooth) < 0.12 * np.linalg.norm(smooth)
    assert abs(where(result.volume, BEADS[0])[0] - BEADS[0][2]) <= 1.2


def test_erasures_of_four_fifths():
    """Fig. 3.7, in depth: a fifth of the pixels still tells where three beads are."""
    erased = np.random.default_rng(3).random((SIZE, SIZE)) < 0.8
    garbled = np.where(erased, 1e6, measurement())
    result = reconstruct(garbled, calibration(), prior="l1", erasures=erased)
    for bead in BEADS:
        assert abs(where(result.volume, bead)[0] - bead[2]) <= 1.5


def test_channels():
    b = measurement()
    result = reconstruct(
        np.stack([b, 2 * b, 0.5 * b, b], axis=-1),
        calibration(),
        prior="l1",
        model="convolution",
        iterations=30,
        noise=2.0,
    )
    assert result.volume.shape == (DEPTHS, SIZE, SIZE, 4)
    single = reconstruct(b, calibration(), prior="l1", model="convolution", iterations=30, noise=2.0)
    np.testing.assert_allclose(result.volume[..., 0], single.volume, atol=1e-3 * single.volume.max())
    assert len(result.histories) == len(result.stop_reasons) == 4


def test_grid_has_its_own_pitch_at_every_depth():
    grid = reconstruct(measurement(), calibration(), iterations=2).grid
    np.testing.assert_allclose(grid.z_um, Z_UM)
    np.testing.assert_allclose(grid.pitch_um, PITCH_UM * Z_UM / (1000 * DISTANCE_MM))
    assert grid.centre == (SIZE // 2, SIZE // 2)
    weights = grid.axis_weights()
    np.testing.assert_allclose(weights[0, 0], grid.pitch_um[0] / (Z_UM[1] - Z_UM[0]))
    np.testing.assert_allclose(weights[:, 1:], 1)


def test_warm_start_callback_and_cancel():
    cold = reconstruct(measurement(), calibration(), prior="l1")
    cancel = threading.Event()
    seen = []

    def callback(record, volume):
        seen.append((record.iteration, volume().shape))
        if record.iteration == 3:
            cancel.set()

    warm = reconstruct(
        measurement(), calibration(), prior="l1", warm=cold, on_progress=callback, cancel=cancel
    )
    assert warm.stop_reasons == (StopReason.CANCELLED,)
    assert seen == [(i, (DEPTHS, SIZE, SIZE)) for i in (1, 2, 3)]
    assert np.linalg.norm(warm.volume - cold.volume) < 0.3 * np.linalg.norm(cold.volume)


def test_refuses_what_does_not_fit_or_puts_it_on_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "lies_in_memory", lambda folder: False)
    plan = memory.plan("tv", (1, DEPTHS, 80, 80), calibration().psfs.size, DEPTHS * SIZE**2)
    half = (plan.work + plan.state / 2) / (1 - memory.KEPT_FREE) / memory.GIB
    with pytest.raises(InputError, match="name a scratch folder"):
        reconstruct(measurement(), calibration(), model="convolution", memory_gib=half)
    with pytest.raises(InputError, match="Bin the images or take fewer depths"):
        reconstruct(measurement(), calibration(), model="convolution", memory_gib=1e-4, scratch=tmp_path)
    result = reconstruct(
        measurement(), calibration(), model="convolution", iterations=5, memory_gib=half, scratch=tmp_path
    )
    same = reconstruct(measurement(), calibration(), model="convolution", iterations=5)
    np.testing.assert_array_equal(result.volume, same.volume)
    assert not list(tmp_path.iterdir()), "scratch files are removed"
    assert "iB of the state in files" in result.provenance["memory"]
    assert "in files" not in same.provenance["memory"]
    monkeypatch.setattr(memory, "lies_in_memory", lambda folder: True)
    with pytest.raises(InputError, match="lies in memory itself"):
        reconstruct(measurement(), calibration(), model="convolution", memory_gib=half, scratch=tmp_path)


@pytest.mark.parametrize("prior", ["l1", "tv"])
def test_only_what_does_not_fit_goes_to_disk(tmp_path, monkeypatch, prior):
    monkeypatch.setattr(memory, "lies_in_memory", lambda folder: False)
    stores = []
    storage = memory.Storage

    def noted(*args):
        stores.append(storage(*args))
        return stores[-1]

    monkeypatch.setattr(memory, "Storage", noted)
    kind = "tv" if prior == "tv" else "l1"
    plan = memory.plan(kind, (1, DEPTHS, 80, 80), calibration().psfs.size, DEPTHS * SIZE**2)
    limit = (plan.work + 0.6 * plan.state) / (1 - memory.KEPT_FREE) / memory.GIB
    settings = {"prior": prior, "iterations": 5, "estimate_background": False, "model": "convolution"}
    settings["judged"] = False  # the calibration's decoys have storage of their own
    result = reconstruct(measurement(), calibration(), memory_gib=limit, scratch=tmp_path, **settings)
    assert 0.3 * plan.state < stores[-1].on_disk < 0.8 * plan.state
    same = reconstruct(measurement(), calibration(), **settings)
    np.testing.assert_array_equal(result.volume, same.volume)


def test_a_folder_in_memory_is_known_by_its_mount():
    assert not memory.lies_in_memory(Path("/proc"))
    if Path("/dev/shm").exists():
        assert memory.lies_in_memory(Path("/dev/shm/no/such"))


def test_plan_counts_the_volumes():
    plan = memory.plan("tv", (1, 128, 512, 512), 0, 0, available=2**30)
    assert plan.state / 2**20 == pytest.approx(6 * 128, rel=0.01)
    assert plan.fits
    assert not memory.plan("tv", (1, 128, 2048, 2048), 0, 0, available=2**33).fits


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"prior": "haar"}, "prior must be one of .*, not 'haar'"),
        ({"model": "exact"}, "model must be one of .*, not 'exact'"),
        ({"model": "local"}, "several places of the field"),
        ({"tau": -1.0}, "tau must be a number, 0 or more"),
        ({"tolerance": -1.0}, "tolerance must be a number, 0 or more"),
        ({"iterations": 2.5}, "iterations must be a whole number"),
        ({"noise": "x"}, "noise must be a NoiseModel"),
        ({"erasures": 0.5}, "erasures is 0.5"),
        ({"field": "all"}, "field must be one of"),
        ({"erasures": np.ones((SIZE, SIZE), bool)}, "leave no pixel"),
    ],
)
def test_refuses_in_words(change, words):
    with pytest.raises(InputError, match=words):
        reconstruct(measurement(), calibration(), **{"iterations": 1, **change})


def test_refuses_unusable_calibrations():
    c = calibration()
    empty = Calibration(c.psfs[:0], c.source_positions_um[:0])
    with pytest.raises(InputError, match="holds no PSF"):
        reconstruct(measurement(), empty)
    constant = Calibration(np.ones_like(c.psfs), c.source_positions_um)
    with pytest.raises(InputError, match="constant"):
        reconstruct(measurement(), constant)


def field_calibration(fall_off_px):
    """Sources on a 3 x 3 grid at one depth; the sensor's response falls with the distance (Eq. 5.1)."""
    psfs, positions = [], []
    for row in (-10, 0, 10):
        for column in (-10, 0, 10):
            psfs.append(render([(row, column, 3, 50.0)], fall_off_px=fall_off_px)[None])
            scale = -PITCH_UM * Z_UM[3] / (1000 * DISTANCE_MM)
            positions.append((column * scale, row * scale, Z_UM[3]))
    return Calibration(np.asarray(psfs, np.float32), np.array(positions))


def test_model_is_chosen_by_how_much_psfs_vary():
    constant = sort_by_depth(field_calibration(None))
    varying = sort_by_depth(field_calibration(20.0))
    assert len(constant.fields) == 1
    assert len(constant.fields[0].points) == 9
    assert choose_model(constant, "auto")[0] == "convolution"
    name, reason = choose_model(varying, "auto")
    assert name in ("local", "lowrank")
    assert "over the field" in reason


def test_sources_are_found_where_they_were():
    depths = sort_by_depth(field_calibration(20.0))
    expected = [(r, c) for r in (-10, 0, 10) for c in (-10, 0, 10)]
    np.testing.assert_allclose(depths.fields[0].points, expected, atol=1)


@pytest.mark.slow
def test_fall_off_needs_the_local_model():
    """Fig. 5.3: with fall-off, one PSF is not enough; interpolated ones are."""
    fall_off = 20.0
    rng = np.random.default_rng(5)
    beads = [
        (r + rng.uniform(-2, 2), c + rng.uniform(-2, 2), 3, 900.0) for r in (-9, 0, 9) for c in (-9, 0, 9)
    ]
    clean = sum(render([b], fall_off_px=fall_off) for b in beads) * 50
    b = rng.poisson(clean) + rng.normal(0, 2, clean.shape)
    c = field_calibration(fall_off)
    noise = NoiseModel(read_noise=2.0, counts_per_electron=1.0)

    def residual(model):
        result = reconstruct(b, c, prior="l1", model=model, noise=noise, estimate_background=False, tau=1e-3)
        light = [
            result.volume[0][round(r) + 18 : round(r) + 23, round(k) + 18 : round(k) + 23].sum()
            for r, k, *_ in beads
        ]
        return result.histories[0][-1].data_residual, np.std(light) / np.mean(light)

    central, spread_central = residual("convolution")
    local, spread_local = residual("local")
    assert local < 0.5 * central
    assert spread_local < 0.5 * spread_central


def test_scratch_files_hold_their_place_on_the_disk(tmp_path):
    storage = memory.Storage(tmp_path)
    storage.zeros((64, 1024), np.float32)
    (file,) = tmp_path.glob("*/*.dat")
    assert file.stat().st_blocks * 512 >= file.stat().st_size == 64 * 1024 * 4
    storage.close()


def test_what_a_killed_program_left_in_the_scratch_folder_is_removed_by_the_next(tmp_path):
    code = (
        "import os, sys, numpy; from recon.solvers.memory import Storage\n"
        "storage = Storage(sys.argv[1]); storage.zeros((64, 64), numpy.float32); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=Path(__file__).parents[2], check=False)
    (left,) = tmp_path.iterdir()
    (tmp_path / "diffuserbench-results").mkdir()
    working = memory.Storage(tmp_path)
    assert not left.exists()
    other = memory.Storage(tmp_path)
    working.zeros((64, 64), np.float32)
    assert len(list(tmp_path.iterdir())) == 3
    working.close()
    other.close()
    assert [path.name for path in tmp_path.iterdir()] == ["diffuserbench-results"]


def test_a_scratch_folder_that_another_program_has_locked_is_not_waited_for(tmp_path, monkeypatch):
    asked, flock = [], fcntl.flock

    def at_once(handle, operation):
        asked.append(operation)
        flock(handle, operation | fcntl.LOCK_NB)

    monkeypatch.setattr(memory.fcntl, "flock", at_once)
    held = os.open(tmp_path, os.O_RDONLY)  # as a run is while it is written
    flock(held, fcntl.LOCK_EX)
    storage = memory.Storage(tmp_path)
    os.close(held)
    assert asked
    assert all(operation & fcntl.LOCK_NB for operation in asked)
    (left,) = tmp_path.iterdir()
    other = memory.Storage(tmp_path)
    assert left.exists(), "its lock is its own"
    storage.close()
    other.close()
    assert not list(tmp_path.iterdir())


def test_psfs_of_another_size_are_refused_and_saturation_is_warned_of():
    with pytest.raises(InputError, match="40 x 40 pixels and the measurement 32 x 40"):
        reconstruct(measurement()[:32], calibration())
    dark = np.random.default_rng(0).uniform(90, 110, (SIZE, SIZE))
    clipped = np.minimum(measurement() + dark, 200)
    result = reconstruct(clipped, calibration(), background=dark, iterations=1)
    assert any("looks saturated" in text for text in result.warnings)


@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_a_dark_measurement_gives_a_dark_volume(prior):
    result = reconstruct(np.zeros((SIZE, SIZE)), calibration(), prior=prior, iterations=3)
    assert not result.volume.any()
    assert any("channel 0 is constant (0 everywhere)" in text for text in result.warnings)


@pytest.mark.parametrize("wrong", [{"tau": np.inf}, {"iterations": 0}, {"time_s": 0.0}, {"tolerance": -1.0}])
def test_settings_without_a_meaning_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        reconstruct(measurement(), calibration(), **wrong)


@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_being_called_back_costs_no_volume_more_at_the_end(monkeypatch, prior):
    solvers = []
    made = tv_admm_volume.volume_solver

    def noted(*args, **options):
        solvers.append(made(*args, **options))
        return solvers[-1]

    monkeypatch.setattr(tv_admm_volume, "volume_solver", noted)
    reconstruct(measurement(), calibration(), prior=prior, iterations=1, on_progress=lambda *_: None)
    assert not solvers[-1].room.keep_state


def test_depths_of_a_stage_that_repeats_imperfectly_are_one():
    def positions(*rows):
        return members_of_depths(np.array(rows, float))

    same = positions((0, 0, 10_000), (500, 0, 10_004), (0, 500, 9_998), (0, 0, 12_000))
    assert [list(g) for g in same] == [[0, 1, 2], [3]]
    fine = positions((0, 0, 10_000), (0, 0, 10_004), (0, 0, 10_008))
    assert [list(g) for g in fine] == [[0], [1], [2]], "one place, three depths"
    unknown = positions((0, 0, np.nan), (500, 0, np.nan))
    assert [list(g) for g in unknown] == [[0], [1]]


def test_empty_planes_are_told():
    settings = {"prior": "l1", "tau": 0.1, "tolerance": 1e-4, "estimate_background": False}
    result = reconstruct(measurement(), calibration(), **settings)
    (empty,) = result.empty_planes
    assert empty.certified
    assert empty.planes
    assert not result.volume[list(empty.planes)].any()
    whole = reconstruct(measurement(), calibration(), model="convolution", drop_empty=False, **settings)
    assert not whole.empty_planes[0].planes
    np.testing.assert_allclose(result.volume, whole.volume, atol=0.02 * whole.volume.max())


def field_scene(fall_off):
    beads = [(r + 0.3, c - 0.4, 3, 900.0) for r in (-9, 0, 9) for c in (-9, 0, 9)]
    clean = sum(render([b], fall_off_px=fall_off) for b in beads) * 50
    rng = np.random.default_rng(5)
    return rng.poisson(clean) + rng.normal(0, 2, clean.shape)


@pytest.mark.parametrize("model", ["auto", "local", "lowrank"])
def test_a_picture_takes_the_model_of_its_field(model):
    b, c = field_scene(20.0), field_calibration(20.0)
    one = reconstruct(b, c, model="convolution", z_um=Z_UM[3], prior="l1", tau=1e-3)
    result = reconstruct(b, c, model=model, prior="l1", tau=1e-3)
    assert result.image.shape == (SIZE, SIZE)
    assert result.model in ("local", "lowrank")
    assert result.history[-1].data_residual < 0.6 * one.history[-1].data_residual
    assert np.isnan(result.grid.pitch_um).all()  # this calibration tells no geometry
    assert result.grid.z_um == pytest.approx([Z_UM[3]])


def test_a_picture_of_colour_and_its_refusals():
    b, c = field_scene(20.0), field_calibration(20.0)
    colour = np.stack([b, 0.5 * b, b], axis=-1)
    seen = []
    result = reconstruct(
        colour,
        c,
        model="local",
        prior="tv",
        iterations=2,
        on_progress=lambda r, image: seen.append(image().shape),
    )
    assert result.image.shape == (SIZE, SIZE, 3)
    assert seen == [(1, SIZE, SIZE)] * 6
    assert reconstruct(b, c, model="local", solver="fista", prior="tv-haar", iterations=2).model == "local"
    with pytest.raises(InputError, match="for one convolution"):
        reconstruct(b, c, model="local", solver="admm-sensor")
    with pytest.raises(InputError, match="several places of the field"):
        reconstruct(b, c.psfs[0, 0], model="lowrank")
    with pytest.raises(InputError, match=r"not 'locl'\. Did you mean 'local'"):
        reconstruct(b, c, model="locl")


@pytest.mark.parametrize("prior", ["l1", "tv"])
def test_a_background_is_not_negative(prior):
    """A dark level taken off too high asks for a negative background: Eq. 6.2 does not allow one."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    b = measurement() - 400 * (1 + np.cos(np.pi * x) * np.cos(np.pi * y))
    seen = []
    result = reconstruct(
        b,
        calibration(),
        prior=prior,
        positive_background=True,
        iterations=60,
        on_progress=lambda r, v: seen.append(v().shape),
    )
    free = reconstruct(b, calibration(), prior=prior, iterations=60, estimate_background=True)
    assert free.background.min() < -50
    assert len(free.histories[0]) <= 60
    assert result.background.min() >= 0
    iterations = [r.iteration for r in result.histories[0]]
    assert iterations == list(range(1, len(iterations) + 1))
    assert len(seen) == len(iterations) > 60
    assert abs(where(result.volume, BEADS[0])[0] - BEADS[0][2]) <= 1.5
