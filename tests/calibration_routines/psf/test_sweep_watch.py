"""What a sweep's watch takes for a pixel that turned hot, and what is light however sharp it is."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from calibration_routines.psf.analysis import DarkModel
from calibration_routines.psf.sweep_options import PointSweep
from calibration_routines.psf.sweep_plan import DARK, PSF, REFERENCE
from calibration_routines.psf.sweep_watch import PointTaken, SourceVisit, SweepEvent, SweepWatch
from drivers.frame import FrameMetadata
from instrument.bench.photograph import Snapshot
from instrument.files.images import read_image
from instrument.plan import Step
from recon.arrays import Float64Array
from recon.evaluation.measured_sets import data_folder
from recon.types import Geometry

FULL = 4095
SHAPE = (120, 160)
RNG = np.random.default_rng(5)
Counts = npt.NDArray[np.uint16]


def snapshot(light: npt.NDArray[np.floating]) -> Snapshot:
    image = np.clip(np.round(light + 100), 0, FULL).astype(np.uint16)
    metadata = FrameMetadata(0, None, 0, datetime.now(UTC), 5.0, 1.0, "Mono12", 12, 0.0, (0, 0, *SHAPE), 1)
    return Snapshot(image, metadata, 1)


def watched(
    lights: Sequence[npt.NDArray[np.floating]], *, visits: bool = False, dark: Sequence[tuple[int, int]] = ()
) -> list[SweepEvent]:
    """Return what is seen of the light of points at depths of their own; ``dark``: hot pixels of those."""
    depths = [60e3 + 10e3 * k for k in range(12)]
    sweep = PointSweep(points_um=tuple((0.0, 0.0, z) for z in depths), average=1, reference_every=2)
    watch = SweepWatch(sweep, Geometry(pixel_pitch_um=13.0, diffuser_distance_mm=8.9))
    seen: list[SweepEvent] = []
    watch.on_event = seen.append
    black = np.zeros(lights[0].shape)
    for pixel in dark:
        black[pixel] = FULL
    for part in range(2):
        watch.see(Step(index=part, part=0, repeat=part, label=DARK), snapshot(black))
    for part, (z_um, light) in enumerate(zip(depths, lights, strict=False), start=1):
        label, at = (REFERENCE, sweep.reference_point) if visits else (PSF, (0.0, 0.0, z_um))
        watch.see(Step(index=part + 1, part=part, repeat=0, label=label, source_um=at), snapshot(light))
    return seen


def qualities(events: Sequence[SweepEvent]) -> list[PointTaken]:
    return [event for event in events if isinstance(event, PointTaken)]


def spots(peak: float) -> Float64Array:
    """Return soft light with spots of a single pixel in it, the brightest as bright as ``peak``."""
    light = np.zeros(SHAPE)
    light[30:90, 40:120] = 200 * ndimage.gaussian_filter(RNG.random((60, 80)), 2)
    for row, column in RNG.integers((35, 45), (85, 115), (20, 2)):
        light[row, column] = peak * RNG.uniform(0.7, 1)
    light[60, 80] = peak
    return light


@pytest.mark.parametrize("hot_in_the_dark", [False, True])
def test_a_sharp_peak_that_saturates_is_counted_and_taken_again_unless_it_is_hot_in_the_dark(
    hot_in_the_dark: bool,
) -> None:
    """It stands alone like a pixel that turned hot, at every depth at its place, and was passed over."""
    light = spots(3600)
    light[60, 80] = FULL
    for event in qualities(watched([light] * 3, dark=[(60, 80)] if hot_in_the_dark else ())):
        assert event.quality.saturated_pixels == (0 if hot_in_the_dark else 1)
        assert event.quality.retake is not hot_in_the_dark


def test_light_of_sharp_spots_that_go_elsewhere_with_depth_stays_in_the_picture() -> None:
    lights = [spots(3000) for _ in range(4)]
    for event, light in zip(qualities(watched(lights)), lights, strict=True):
        assert event.image.sum() == pytest.approx(light.sum(), rel=0.01)


def test_what_stays_at_its_place_at_two_places_of_the_source_turned_hot() -> None:
    soft = 400 * ndimage.gaussian_filter(RNG.random(SHAPE), 3)
    lights = [np.roll(soft, 3 * k, 0) for k in range(4)]
    hot = tuple(RNG.integers(5, (SHAPE[0] - 5, SHAPE[1] - 5), (30, 2)).T)
    for light in lights[1:]:
        light[hot] += 3000
    images = [event.image for event in qualities(watched(lights))]
    assert images[1][hot].min() > 2500  # of one place nobody can tell
    assert images[2][hot].max() < 500
    assert images[3][hot].max() < 500


@pytest.mark.parametrize("they_stay", [True, False])
def test_pixels_that_turn_hot_between_two_visits_are_no_other_light(they_stay: bool) -> None:
    soft = np.zeros(SHAPE)
    soft[30:90, 40:120] = 400 * ndimage.gaussian_filter(RNG.random((60, 80)), 1)
    late = soft.copy()
    late[tuple(RNG.integers(5, (SHAPE[0] - 5, SHAPE[1] - 5), (60, 2)).T)] += 3000
    visits = watched([soft, late, late if they_stay else soft], visits=True)
    assert len(visits) == 3
    for visit in visits:
        assert isinstance(visit, SourceVisit)
        assert not visit.findings
        assert visit.brightness == pytest.approx(1, abs=0.01)


def test_other_light_and_a_lamp_of_sharp_spots_are_told_between_visits() -> None:
    light = spots(3000)
    dimmer, other = watched([light, 0.5 * light, light + 0.3 * light.mean()], visits=True)[1:]
    assert isinstance(dimmer, SourceVisit)
    assert isinstance(other, SourceVisit)
    assert dimmer.brightness == pytest.approx(0.5, abs=0.01)
    assert "other light came in" in " ".join(other.findings)


@pytest.mark.parametrize("full_scale", [255, FULL])
def test_single_photons_in_the_dark_are_no_hot_pixels(full_scale: int) -> None:
    """Most pixels see none, so that their noise seemed to be none: up to 17 % of all were taken."""
    black = np.zeros((2, *SHAPE), np.uint16)
    dark = DarkModel((1.0,), (black,), full_scale)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spot = 40 * np.exp(-((rows - 60.0) ** 2 + (columns - 80.0) ** 2) / 800)
    for light in (0.2 * np.ones(SHAPE), spot):
        for frames in (1, 4):
            image = RNG.poisson(light, (frames, *SHAPE)).mean(axis=0).astype(np.float32)
            assert not dark.lone(image).any()


@pytest.mark.skipif(
    not (data_folder() / "diffusercam_usaf3d").is_dir(), reason="the USAF target is not there"
)
def test_peaks_of_measured_psfs_are_light() -> None:
    """86 to 116 of each depth had been taken for hot, and a saturated one was not counted."""
    files = [data_folder() / "diffusercam_usaf3d" / f"psf{k:02d}.tiff" for k in range(0, 44, 4)]
    psfs = [np.squeeze(read_image(file).pixels).astype(np.float64) for file in files]
    lights = [(FULL - 100) * psf / psf.max() for psf in psfs]  # peaks at full scale
    events = qualities(watched(lights))
    assert len(events) == 11
    for event, light in zip(events, lights, strict=True):
        assert event.quality.saturated_pixels >= 1
        assert event.quality.retake
        assert event.image.sum() > 0.99 * np.maximum(light, 0).sum()
