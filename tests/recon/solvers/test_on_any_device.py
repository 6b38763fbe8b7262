"""The solvers of any device, run on NumPy: against their compiled sweeps, iteration by iteration."""

import sys
import types

import numpy as np
import pytest

import recon
from benchmarks import gpu
from recon.base import threads
from recon.base.metrics import psnr
from recon.base.namespace import array_namespace, require_memory
from recon.camera.convolution import Convolution
from recon.camera.factors import BackgroundRemoval
from recon.errors import InputError
from recon.priors import L1, NonNegativity, TotalVariation
from recon.solvers import StoppingRules
from recon.solvers.douglas_rachford import DouglasRachford, SparseDouglasRachford
from recon.solvers.splitting import Room, SensorData
from recon.solvers.tv_admm_volume import LeanTotalVariation
from recon.solvers.volume_admm import VolumeAdmm

SENSOR = (12, 11)


@pytest.fixture(autouse=True)
def any_memory(monkeypatch):
    """The twin has no memory of its own to ask for."""
    for module in ("volume_admm", "douglas_rachford"):
        monkeypatch.setattr(f"recon.solvers.{module}.require_memory", lambda *_: None)


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


# Another module than numpy, with its functions: what a GPU's is to the code.
TWIN = types.ModuleType("twin")
TWIN.__dict__.update({k: v for k, v in np.__dict__.items() if not k.startswith("__")})


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
    whole, first, second = (solver(operator, data, prior, room=Room(TWIN)) for _ in range(3))
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
    monkeypatch.setattr("recon.reconstruction.part.array_namespace", lambda _device: TWIN)
    plain = recon.reconstruct(shot.measurement, shot.psf, device="gpu")
    assert plain.image.dtype == np.float32
    assert psnr(plain.image, shot.truth) > 26
    colour = np.stack([shot.measurement, 0.5 * shot.measurement], axis=-1)
    found, host = (
        recon.reconstruct(colour, shot.psf, device=device, iterations=300, tolerance=0)
        for device in ("gpu", "cpu")
    )
    assert found.image.shape == host.image.shape
    assert np.linalg.norm(found.image - host.image) < 0.02 * np.linalg.norm(host.image)


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
    monkeypatch.setattr("recon.reconstruction.part.array_namespace", lambda _device: TWIN)
    device = recon.reconstruct(measurement, calibration, device="gpu", **options)
    assert host.volume.max() > 0
    np.testing.assert_allclose(device.volume, host.volume, atol=2e-3 * host.volume.max())
    with pytest.raises(InputError, match=r"local model|several places"):
        recon.reconstruct(measurement, calibration, device="gpu", model="local")


def test_the_benchmark_of_a_gpu_finds_volumes_alike(capsys: pytest.CaptureFixture[str]) -> None:
    gpu.main(["--numpy", "--sizes", "16", "--depths", "3", "--iterations", "3"])
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if " 16 x 16 x 3 " in line]
    assert len(rows) == 2 * len(gpu.PRIORS)  # as they come, and in the page
    assert all(float(row[6]) < 1e-3 for row in rows), rows
