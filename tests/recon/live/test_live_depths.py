"""Live pictures of several depths: what each is of, and what makes pictures at one resolution."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon import Calibration, InputError
from recon.base.metrics import psnr
from recon.streams.detail import Detail
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import DARK, NOISE_ONLY, UNLIT, LivePicture
from recon.streams.pace import Spent
from tests.recon.live.streams import NOISE, SHAPE, live, photograph, spots_psf


def test_calibration_with_background_and_depths() -> None:
    psfs = np.stack([spots_psf(), np.roll(spots_psf(), 5, 1)])[:, None]
    places = np.array([[0, 0, 1000.0], [0, 0, 2000.0]])
    calibration = Calibration(psfs, places, np.full((1, *SHAPE), 20.0, np.float32))
    reconstructor = LiveReconstructor(calibration, z_um=1000.0, noise=NOISE, budget_ms=25.0, coarsest=1)
    assert psnr(reconstructor.feed(photograph(0, 0)).image, live().feed(photograph(0, 0)).image) > 60


@pytest.mark.parametrize("plane", [None, 2])
def test_a_picture_says_which_depths_it_is_of(plane: int | None) -> None:
    psfs = np.stack([np.roll(spots_psf((32, 32), 9), 3 * k, 1) for k in range(4)])[:, None]
    z_um = np.c_[np.zeros((4, 2)), [1000.0, 2000.0, 3000.0, 4000.0]]
    reconstructor = LiveReconstructor(Calibration(psfs, z_um), noise=1.0, coarsest=1, plane=plane)
    reconstructor._shape = (32, 32)
    volume = np.random.default_rng(0).random((4, 32, 32)).astype(np.float32)
    solver = SimpleNamespace(iterations=7)

    def picture(planes: tuple[int, ...], volume: np.ndarray, done: int | None, **known: Any) -> LivePicture:
        level: Any = SimpleNamespace(
            **{
                "detail": Detail(2, planes),
                "binning": 2,
                "method": "admm",
                "solver": solver,
                "camera": lambda **_: "",
            }
            | known
        )
        return reconstructor._picture(level, volume, done, Spent(0.0, 0.0))

    every = (0, 1, 2, 3)
    iterated = picture(every, volume, 3)
    assert (iterated.method, iterated.iterations, iterated.total_iterations) == ("admm", 3, 7)
    assert iterated.volume is volume
    assert iterated.planes == every
    if plane is None:
        np.testing.assert_array_equal(iterated.image, volume.max(axis=0))
        assert iterated.shown == "brightest of 4 depths"
    else:
        np.testing.assert_array_equal(iterated.image, volume[2])
        assert iterated.shown == "depth 2 of 4 depths"
    two = picture((2, 3), volume[:2], 3)
    assert two.planes == (2, 3)
    np.testing.assert_array_equal(two.image, volume[:2].max(axis=0) if plane is None else volume[0])
    assert "2 of 4 depths (3, 4 mm)" in two.shown
    for planes, middle in ((every, 2), ((0, 1, 3), 1)):
        filtered = picture(planes, volume[:1], 0)
        assert (filtered.method, filtered.iterations, filtered.total_iterations) == ("wiener", 0, 0)
        assert filtered.volume is None
        assert filtered.planes == (middle if plane is None else 2,)
        assert filtered.shown == f"depth {middle if plane is None else 2} of 4 depths"
        np.testing.assert_array_equal(filtered.image, volume[0])
    assert picture(every, volume, 1, solver=None).total_iterations == 0
    reconstructor._dark, reconstructor._settled = True, True
    black = picture(every, volume[:1], None)
    assert (black.method, black.iterations, black.doubt, black.settled) == ("", 0, DARK, True)
    assert picture(every, volume, 2).doubt == NOISE_ONLY
    reconstructor._dark, reconstructor._fit._doubt = False, "It is another's"
    assert picture(every, volume[:1], None).doubt == UNLIT
    assert picture(every, volume, 2).doubt == "It is another's"


@pytest.mark.parametrize(("binning", "planes"), [(1, (0, 1, 2, 3)), (1, (0, 2)), (2, (1, 3))])
def test_a_level_has_its_pixels_and_depths_and_is_judged_by_all_depths(
    binning: int, planes: tuple[int, ...]
) -> None:
    psfs = np.stack([np.roll(spots_psf((32, 32), 9), 3 * k, 1) for k in range(4)])[:, None]
    z_um = np.c_[np.zeros((4, 2)), [1000.0, 2000.0, 3000.0, 4000.0]]
    reconstructor = LiveReconstructor(Calibration(psfs, z_um), noise=1.0, coarsest=2)
    frame = reconstructor._measured(np.random.default_rng(0).poisson(900 * psfs[1, 0]).astype(np.float32))
    level = reconstructor._level_of(Detail(binning, planes), frame)
    side = 32 // binning
    for problem, n_planes in ((level.problem, len(planes)), (level.whole, 4)):
        assert (problem.n_planes, problem.sensor_shape) == (n_planes, (side, side))
        assert problem.depths.central.shape[2:] == (side, side)
    assert level.problem is level.whole or len(planes) < 4
    kept = level.problem.depths.z_um
    np.testing.assert_array_equal(kept, 1000.0 * (1 + np.array(planes)))
    shown = planes[len(planes) // 2]
    assert level.preview.problem.n_planes == 1
    own = level.whole.depths.central[shown, 0]
    seen = level.preview.problem.depths.central[0, 0]
    np.testing.assert_allclose(seen / seen.sum(), own / own.sum(), atol=1e-6)


@pytest.mark.parametrize("channels", [None, 3])
def test_a_whole_picture_has_the_frame_on_the_calibration_s_pixels(
    channels: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr("recon.streams.live.reconstruct", lambda *given, **more: asked.append((given, more)))
    reconstructor = live()
    frame = np.random.default_rng(0).random((2 * SHAPE[0], 2 * SHAPE[1], channels or 1)) * 99
    frame = frame if channels else frame[..., 0]
    reconstructor.full(frame, cancel=None)
    ((measurement, psf, options), more) = asked[0]
    binned = frame.reshape(SHAPE[0], 2, SHAPE[1], 2, -1).mean(axis=(1, 3))
    np.testing.assert_allclose(
        measurement.image,
        binned if channels else binned[..., 0],
        rtol=1e-5,
        err_msg="height, width, channels",
    )
    assert measurement.background == 20.0
    assert options is reconstructor.options
    np.testing.assert_array_equal(psf, spots_psf())
    assert more == {"on_progress": None, "cancel": None}
    frame[3, 4] = np.nan
    with pytest.raises(InputError, match="frame"):
        reconstructor.full(frame)
    assert len(asked) == 1
