"""The solvers of any device, run on NumPy: against their compiled sweeps, iteration by iteration."""

import sys
import types
from pathlib import Path

import numpy as np
import pytest
from scipy.fft import dctn

import recon
from benchmarks import gpu
from recon.base import fft, threads
from recon.base.metrics import psnr
from recon.base.namespace import array_namespace, require_memory
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution, low_rank
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.priors import L1, NonNegativity, TotalVariation
from recon.reconstruction.options import ReconstructionOptions
from recon.solvers import StoppingRules
from recon.solvers.douglas_rachford import DouglasRachford, SparseDouglasRachford
from recon.solvers.splitting import Room, SensorData
from recon.solvers.tv_admm_volume import LeanTotalVariation
from recon.solvers.volume_admm import VolumeAdmm
from recon.streams.live import LiveReconstructor
from recon.streams.video import VideoSolver, stream_problem
from tests.device import LIBRARY, played

SENSOR = (12, 11)


@pytest.fixture(autouse=True)
def one_thread():
    """Arrays of a hundred numbers: handing them to another thread takes longer than the work."""
    before = threads.get_threads()
    threads.set_threads(1)
    yield
    threads.set_threads(before)


def problem(dtype=np.float64, n_z=5):
    rng = np.random.default_rng(0)
    psfs = (rng.standard_normal((n_z, 1, 10, 9)) + 0.2).astype(dtype)
    operator = Convolution(psfs, SENSOR, dtype=dtype)
    x = np.zeros(operator.domain_shape, dtype)
    x[0, n_z // 2, 3:7, 4:7] = 1
    x[0, min(1, n_z - 1), 5:8, 2:6] += 2
    data = operator.forward(x)
    data += 0.01 * data.std() * rng.standard_normal(data.shape).astype(dtype)
    return operator, data


def tv(weight, **options):
    return TotalVariation.of_volume(weight, **options) + NonNegativity()


def l1(weight):
    return L1(weight) + NonNegativity()


@pytest.fixture(params=[False, True], ids=["all pixels", "erased and background"])
def masks(request):
    if not request.param:
        return None, None
    valid = np.random.default_rng(1).random(SENSOR) > 0.2
    return valid, BackgroundRemoval((1, *SENSOR), (3, 3), valid, dtype=np.float64)


@pytest.mark.parametrize("n_z", [1, 5])
def test_l1_does_what_the_compiled_solver_does(n_z, masks):
    operator, data = problem(n_z=n_z)
    valid, background = masks
    weight = 0.02 * float(np.abs(operator.adjoint(data)).max())
    measured = SensorData(data, valid, background)
    plain = DouglasRachford(operator, measured, l1(weight))
    compiled = SparseDouglasRachford(operator, measured, l1(weight))
    rules = StoppingRules(iterations=60, tolerance=0)
    one, other = plain.run(rules), compiled.run(rules)
    assert one.solution.max() > 0
    np.testing.assert_allclose(one.solution, other.solution, atol=1e-4 * other.solution.max())
    for mine, theirs in zip(one.history[::10], other.history[::10], strict=True):
        assert mine.objective == pytest.approx(theirs.objective, rel=1e-4)


@pytest.mark.parametrize("isotropic", [False, True])
@pytest.mark.parametrize("n_z", [1, 5])
def test_total_variation_does_what_the_compiled_solver_does(n_z, isotropic, masks):
    operator, data = problem(n_z=n_z)
    valid, background = masks
    weights = np.random.default_rng(3).uniform(0.5, 2, (n_z, 3))
    weight = 0.002 * float(np.abs(operator.adjoint(data)).max())
    options = {"axis_weights": weights, "isotropic": isotropic}
    measured = SensorData(data, valid, background)
    plain = VolumeAdmm(operator, measured, tv(weight, **options))
    compiled = LeanTotalVariation(operator, measured, tv(weight, **options))
    rules = StoppingRules(iterations=60, tolerance=0)
    one, other = plain.run(rules), compiled.run(rules)
    np.testing.assert_allclose(one.solution, other.solution, atol=1e-3 * other.solution.max())
    for mine, theirs in zip(one.history[::10], other.history[::10], strict=True):
        assert mine.objective == pytest.approx(theirs.objective, rel=1e-3)


@pytest.mark.parametrize(("solver", "prior"), [(DouglasRachford, l1(1.0)), (VolumeAdmm, tv(1.0))])
def test_goes_on_from_a_checkpoint_to_the_last_bit(solver, prior):
    operator, data = problem(np.float32)
    with played() as xp:
        whole, first, second = (solver(operator, data, prior, room=Room(xp)) for _ in range(3))
        whole.run(StoppingRules(iterations=14, tolerance=0))
        first.run(StoppingRules(iterations=7, tolerance=0))
        second.restore(first.checkpoint())
        second.run(StoppingRules(iterations=14, tolerance=0))
    np.testing.assert_array_equal(second.solution, whole.solution)


def test_a_start_is_where_it_begins():
    operator, data = problem()
    rules = StoppingRules(iterations=300, tolerance=0)
    converged = VolumeAdmm(operator, data, tv(1.0)).run(rules).solution
    cold, warm = (VolumeAdmm(operator, data, tv(1.0), initial=start) for start in (None, converged))
    for solver in (cold, warm):
        solver.run(StoppingRules(iterations=3, tolerance=0))
    errors = [np.linalg.norm(s.solution - converged) for s in (cold, warm)]
    assert errors[1] < 0.5 * errors[0]


def test_what_is_missing_is_said(monkeypatch):
    assert array_namespace("cpu") is np
    with pytest.raises(InputError, match="device 'tpu' is not known"):
        array_namespace("tpu")
    monkeypatch.setitem(sys.modules, "cupy", None)
    with pytest.raises(InputError, match=r'pip install "diffuserbench\[gpu\]"'):
        array_namespace("gpu")
    runtime = types.SimpleNamespace(getDeviceCount=lambda: 0, memGetInfo=lambda: (2**30, 2**31))
    fake = types.SimpleNamespace(cuda=types.SimpleNamespace(runtime=runtime))
    monkeypatch.setitem(sys.modules, "cupy", fake)
    with pytest.raises(InputError, match="finds no GPU"):
        array_namespace("gpu")
    require_memory(fake, 2**30)
    with pytest.raises(InputError, match=r"needs 2\.0 GiB, and 1\.0 GiB are free"):
        require_memory(fake, 2**31)


@pytest.mark.gpu
def test_on_a_gpu_as_on_the_host():
    cupy = pytest.importorskip("cupy", reason="needs a GPU and the [gpu] extra")
    if cupy.cuda.runtime.getDeviceCount() == 0:
        pytest.skip("no GPU")
    operator, data = problem(np.float32)
    for solver, prior in ((DouglasRachford, l1(1.0)), (VolumeAdmm, tv(1.0))):
        rules = StoppingRules(iterations=40, tolerance=0)
        results = [solver(operator, data, prior, room=Room(xp)).run(rules) for xp in (np, cupy)]
        largest = results[0].solution.max()
        np.testing.assert_allclose(results[1].solution, results[0].solution, atol=1e-3 * largest)


def test_a_picture_on_the_device_is_that_of_the_host_or_says_what_to_install(monkeypatch, shoot):
    shot = shoot()
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "cupy", None)
        with pytest.raises(InputError, match="needs CuPy"):
            recon.reconstruct(shot.measurement, shot.psf, device="gpu")
    colour = np.stack([shot.measurement, 0.5 * shot.measurement], axis=-1)
    with played():
        plain = recon.reconstruct(shot.measurement, shot.psf, device="gpu", judged=False)
        asked = {"solver": "admm", "estimate_background": True, "iterations": 20, "tolerance": 0}
        found, host = (
            recon.reconstruct(colour, shot.psf, device=device, judged=False, **asked)
            for device in ("gpu", "cpu")
        )
    assert plain.image.dtype == np.float32
    assert psnr(plain.image, shot.truth) > 26
    assert found.image.shape == host.image.shape
    assert np.linalg.norm(found.image - host.image) < 1e-3 * np.linalg.norm(host.image)


@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_a_volume_on_the_device_is_that_of_the_host(monkeypatch, prior):
    rng = np.random.default_rng(5)
    psfs = rng.random((3, 1, 16, 18)).astype(np.float32) ** 8
    calibration = recon.Calibration(
        psfs, np.stack([0 * np.ones(3), 0 * np.ones(3), np.arange(1.0, 4)], axis=1)
    )
    x = np.zeros((1, 3, *Convolution(psfs, (16, 18)).grid_shape), np.float32)
    x[0, 1, 14:18, 15:20] = 5
    measurement = Convolution(psfs, (16, 18)).forward(x)[0] + rng.normal(0, 0.05, (16, 18))
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "cupy", None)
        with pytest.raises(InputError, match="needs CuPy"):
            recon.reconstruct(measurement, calibration, prior=prior, device="gpu")
    options = {"prior": prior, "iterations": 40, "tolerance": 0, "model": "convolution"}
    host = recon.reconstruct(measurement, calibration, drop_empty=False, **options)
    with played():
        device = recon.reconstruct(measurement, calibration, device="gpu", **options)
    assert host.volume.max() > 0
    np.testing.assert_allclose(device.volume, host.volume, atol=2e-3 * host.volume.max())


@pytest.mark.parametrize("model", [local_convolution, low_rank])
@pytest.mark.parametrize("scattered", [False, True])
def test_a_varying_camera_on_the_device_is_that_of_the_host(model, scattered):
    rng = np.random.default_rng(0)
    points = rng.uniform(-9, 9, (5, 2)) if scattered else [(r, c) for r in (-8, 0, 8) for c in (-8, 1, 8)]
    fields = [FieldOfPsfs(rng.random((len(points), 1, 9, 8)).astype(np.float32), points) for _ in range(2)]
    host = model(fields, (20, 21))
    x, y = (rng.random(shape).astype(np.float32) for shape in (host.domain_shape, host.range_shape))
    with played() as xp:
        device = model(fields, (20, 21), xp=xp)
        assert device.nbytes > 0
        np.testing.assert_allclose(device.forward(xp.asarray(x)).get(), host.forward(x), rtol=2e-5)
        np.testing.assert_allclose(device.adjoint(xp.asarray(y)).get(), host.adjoint(y), rtol=2e-5, atol=1e-4)
        np.testing.assert_array_equal(device.forward(x), device.forward(xp.asarray(x)).get())
        assert device.norm_bound == pytest.approx(host.norm_bound, rel=0.15)


@pytest.mark.parametrize("model", ["local", "lowrank"])
@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_through_varying_psfs_the_device_finds_what_the_host_does(model, prior):
    made = make_scene("dense-picture", size=32, grid=2, aberration=0.5)
    options = {"model": model, "prior": prior, "iterations": 20, "tolerance": 0, "judged": False}
    host = recon.reconstruct(made.measurement, made.calibration, **options)
    with played():
        device = recon.reconstruct(made.measurement, made.calibration, device="gpu", **options)
    assert host.volume.max() > 0
    assert np.linalg.norm(device.volume - host.volume) < 5e-3 * np.linalg.norm(host.volume)


@pytest.mark.parametrize("model", ["convolution", "local"])
def test_a_video_on_the_device_is_that_of_the_host(model):
    made = make_scene("beads", size=32, grid=2)
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1, (3, *made.measurement.shape)).astype(np.float32)
    frames = list(made.measurement + noise)

    def film(device):
        options = ReconstructionOptions(device=device, model=model, drop_empty=False)
        posed = stream_problem(frames[0], made.calibration, options, choosing=False)
        with VideoSolver(posed) as solver:
            return [solver.next(frame) for frame in frames]

    host = film("cpu")
    with played():
        device = film("gpu")
    for one, other in zip(host, device, strict=True):
        assert np.linalg.norm(one - other) < 0.02 * np.linalg.norm(one)


def test_live_pictures_are_made_on_the_device():
    made = make_scene("beads", size=32)
    with played():
        live = LiveReconstructor(made.calibration, device="gpu")
        live.feed(made.measurement)
        pictures = [live.refine() for _ in range(3)]  # each waits for the solver, and iterates
    assert max(picture.total_iterations for picture in pictures if picture is not None) > 0


@pytest.mark.parametrize("shape", [(1, 6, 5), (3, 8, 1), (2, 5, 7)])
def test_cosine_transforms_of_the_device(shape):
    x = np.random.default_rng(0).random(shape)
    with played() as xp:
        X = fft.dct(xp.asarray(x), xp.empty(shape))
        back = fft.idct(X, xp.empty(shape))
    np.testing.assert_allclose(X.get(), dctn(x, norm="ortho"), atol=1e-12)
    np.testing.assert_allclose(back.get(), x, atol=1e-12)


def test_the_played_device_takes_no_arrays_of_the_host():
    ours, theirs = np.ones((2, 3)), LIBRARY.ones((2, 3))
    for wrong in (lambda: ours * theirs, lambda: theirs + ours, lambda: LIBRARY.sum(ours)):
        with pytest.raises(TypeError, match="of the host"):
            wrong()
    with pytest.raises(TypeError, match="of the host"):
        theirs[0] = ours[0]
    assert float((2 * theirs)[1].sum()) == 6


def test_the_benchmark_of_a_gpu_finds_all_kinds_alike(tmp_path: Path) -> None:
    out = tmp_path / "gpu.md"
    gpu.main(["--numpy", "--sizes", "16", "--depths", "3", "--iterations", "3", "--out", str(out)])
    rows = [line.split("|") for line in out.read_text().splitlines() if " 16 x 16 x " in line]
    assert [row[1].split(",")[0].strip() for row in rows] == list(gpu.KINDS)
    apart = {row[1].split(",")[0].strip(): float(row[6]) for row in rows}
    del apart["live"]  # such pictures end as time has it
    assert max(apart.values()) < 1e-3, apart
