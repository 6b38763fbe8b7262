"""Losses: gradients by finite differences, images against coefficients; one of a user, found everywhere."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from recon.errors import InputError
from recon.evaluation.chart_hologram import HologramProblem
from recon.holography import (
    LOSSES,
    Display,
    HologramModel,
    HologramOptions,
    Loss,
    Target,
    compute_hologram,
    random_mask,
)

RNG = np.random.default_rng(11)
SHAPE = (12, 16)


class Charbonnier(Loss):
    """``L = mean(sqrt(d^2 + e^2))``: outliers count less than with a square."""

    name = "charbonnier"
    help = "What the eye resolves counts, outliers less than with a square."
    EDGE = 0.05

    def value(self, difference, wanted, weights):
        return float(np.mean(np.sqrt(difference**2 + self.EDGE**2)))

    def gradient(self, difference, wanted, weights):
        return difference / np.sqrt(difference**2 + self.EDGE**2) / difference.size


class Relative(Loss):
    """``L = 1/2 mean(w (d / (T + 0.1))^2)``: dark parts count as much; every pixel of the grid."""

    name = "relative"
    help = "Dark parts count as much as bright ones."
    low_passed = False
    takes_wanted = True
    takes_weights = True

    def value(self, difference, wanted, weights):
        return float(np.mean(weights * (difference / (wanted + 0.1)) ** 2)) / 2

    def gradient(self, difference, wanted, weights):
        return weights * difference / (wanted + 0.1) ** 2 / difference.size


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(LOSSES, "_foreign", dict(LOSSES._foreign))
    return LOSSES.register(Charbonnier()).name


def make_model(loss, **options):
    display = Display(SHAPE, random_mask((24, 32), seed=3))
    targets = [Target(RNG.random((24, 32))), Target(RNG.random((24, 32)), 40.0)]
    return HologramModel(display, targets, loss=loss, dtype=np.complex128, **options)


def random_field():
    return RNG.normal(size=(1, *SHAPE)) + 1j * RNG.normal(size=(1, *SHAPE))


@pytest.mark.parametrize("loss", [*LOSSES.values(), Charbonnier(), Relative()], ids=lambda loss: loss.name)
def test_the_gradient_of_a_loss_agrees_with_finite_differences(loss):
    difference, wanted, weights, change = (RNG.normal(size=(6, 7)) for _ in range(4))
    wanted, weights = np.abs(wanted), np.abs(weights) if loss.takes_weights else None
    h = 1e-6
    up, down = (loss.value(difference + s * h * change, wanted, weights) for s in (1, -1))
    gradient = loss.gradient(difference, wanted, weights)
    assert np.vdot(gradient, change) == pytest.approx((up - down) / (2 * h), rel=1e-6)
    value, again = loss.evaluate(difference.copy(), wanted, weights)
    assert value == pytest.approx(loss.value(difference, wanted, weights))
    np.testing.assert_allclose(again, gradient, rtol=1e-12)


@pytest.mark.parametrize("loss", [Charbonnier(), Relative()], ids=lambda loss: loss.name)
@pytest.mark.parametrize("grid", ["alias-free", "dissertation"])
def test_a_models_gradient_with_any_loss_agrees_with_finite_differences(loss, grid):
    model = make_model(loss, grid=grid)
    at, change, h = random_field(), random_field(), 1e-5
    numeric = (model.evaluate(at + h * change).loss - model.evaluate(at - h * change).loss) / (2 * h)
    assert 2 * np.real(np.vdot(model.evaluate(at).gradient, change)) == pytest.approx(numeric, rel=1e-6)


@pytest.mark.parametrize("name", ["none", "frequency"])
def test_the_sum_over_coefficients_is_the_value_of_the_image(name):
    plain = type("Plain", (type(LOSSES[name]),), {"mean_square": False})()
    slm = random_field()
    by_image, by_spectrum = (make_model_at(loss).evaluate(slm) for loss in (plain, name))
    assert by_image.loss == pytest.approx(by_spectrum.loss, rel=1e-10)
    np.testing.assert_allclose(by_image.gradient, by_spectrum.gradient, rtol=1e-8, atol=1e-14)


def make_model_at(loss):
    display = Display(SHAPE, random_mask((24, 32), seed=3))
    image = np.random.default_rng(2).random((24, 32))
    return HologramModel(display, [Target(image)], loss=loss, dtype=np.complex128)


def test_a_registered_loss_is_found_by_recon(registered):
    model = make_model(registered)
    found = compute_hologram(model, iterations=10)
    assert found.history[-1].loss < 0.7 * found.history[0].loss
    with pytest.raises(InputError, match=r"charbonnier.*Did you mean 'charbonnier'\?"):
        HologramOptions(loss="charbonnie")


def test_a_registered_loss_is_found_by_the_chart(registered):
    display = Display((16, 16), random_mask((32, 32)))
    problem = HologramProblem((display,), ((Target(RNG.random((64, 64))),),), (1,))
    (setting,) = (s for s in problem.settings() if s.loss == registered and s.method == "lbfgs")
    assert setting.name == "4x charbonnier loss"
    points = problem.run(setting, counts=(1, 3)).points
    assert points[-1].psnr_db > points[0].psnr_db


def test_a_registered_loss_is_found_by_the_terminal(registered, capsys, tmp_path: Path, monkeypatch):
    from instrument.bench.config_file import template
    from instrument.cli import main
    from instrument.files.images import write_image
    from instrument.files.slm_image import read_slm_image

    monkeypatch.delitem(sys.modules, "instrument.cli.display", raising=False)
    monkeypatch.chdir(tmp_path)
    small = template().replace("shape = [1080, 1920]", "shape = [96, 128]")
    Path("bench.toml").write_text(small.replace("expansion = 16 ", "expansion = 4 "))
    write_image("picture.png", (RNG.random((80, 80)) * 255).astype(np.uint8))
    assert main(["hologram", "--help"]) == 0
    assert registered in capsys.readouterr().out
    assert main(["hologram", "picture.png", "--loss", registered, "--iterations", "2"]) == 0
    assert read_slm_image("slm.png")[1]["options"]["loss"] == registered
