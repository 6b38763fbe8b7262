"""Holograms on a device that NumPy plays, against the compiled model."""

from __future__ import annotations

import numpy as np
import pytest

from recon.errors import InputError
from recon.holography import (
    DcTerm,
    Display,
    HologramModel,
    Target,
    compute_hologram,
    foveal_weights,
    random_mask,
)
from recon.holography.target import Window
from tests.device import played

RNG = np.random.default_rng(5)


def display(**options):
    return Display((12, 16), random_mask((24, 32), seed=3), dc=DcTerm(0.1, 0.7), mask_fill=0.9, **options)


@pytest.mark.parametrize("grid", ["alias-free", "dissertation"])
@pytest.mark.parametrize("loss", ["none", "frequency", "spatial", "window"])
def test_loss_and_gradient_are_those_of_the_compiled_model(grid, loss):
    options = {"loss": "frequency" if loss == "window" else loss, "grid": grid, "frames": 2}
    options["weights"] = foveal_weights((20, 20)) if loss == "spatial" else None
    window = Window(0.1, 0.7, 0.2, 0.9) if loss == "window" else None
    targets = [Target(RNG.random((24, 32)), z, window=window) for z in (0.0, 40.0)]
    host = HologramModel(display(), targets, dtype=np.complex128, **options)
    slm = np.exp(1j * RNG.uniform(0, 6, (2, 12, 16)))
    ours = host.evaluate(slm)
    with played() as xp:
        device = HologramModel(display(), targets, device="gpu", dtype=np.complex128, **options)
        theirs = device.evaluate(xp.asarray(slm))
        gradient = theirs.gradient.get()
    assert theirs.loss == pytest.approx(ours.loss, rel=1e-9)
    assert theirs.seen_psnr_db == pytest.approx(ours.seen_psnr_db, rel=1e-6)
    np.testing.assert_allclose(gradient, ours.gradient, atol=1e-9 * np.abs(ours.gradient).max())


@pytest.mark.parametrize("kind", ["phase", "complex", "levels"])
def test_a_hologram_is_as_good_as_on_the_host(kind):
    target = Target(RNG.random((24, 32)))
    given = {"complex_slm": kind == "complex"} | ({"light": 0.3} if kind == "complex" else {})
    search = {"iterations": 10, "tolerance": 0.0, "phase_levels": 16 if kind == "levels" else None}
    host = HologramModel(display(), [target], **given)
    ours = compute_hologram(host, **search)
    told = []
    with played():
        device = HologramModel(display(), [target], device="gpu", **given)
        theirs = compute_hologram(device, callback=lambda record, slm: told.append(slm), **search)
    assert type(theirs.slm) is np.ndarray
    assert all(type(slm) is np.ndarray for slm in told)
    assert theirs.history[-1].psnr_db == pytest.approx(ours.history[-1].psnr_db, abs=0.2)
    assert host.evaluate(theirs.slm).seen_psnr_db == pytest.approx(theirs.history[-1].psnr_db, abs=0.01)


@pytest.mark.parametrize(
    ("given", "said"),
    [({"method": "nesterov"}, "the method 'nesterov'"), ({"mirrors": "optimised"}, "mirrors")],
)
def test_what_only_the_host_knows_is_said(given, said):
    with played(), pytest.raises(InputError, match=f"On the gpu there are no {said}: take the cpu"):
        HologramModel(display(), [Target(RNG.random((24, 32)))], device="gpu", **given)
    moved = display(displacement=np.ones((3, 4, 2)))
    with played(), pytest.raises(InputError, match="displaced masks"):
        HologramModel(moved, [Target(RNG.random((24, 32)))], device="gpu")
