"""PSF and image are matched, dark-subtracted, cropped and binned; what cannot belong together is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from instrument.files.calibration_file import find_calibration, save_calibration
from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile, write_image
from instrument.reconstruction.defects import defective_pixels, mended_psf, mended_stack
from instrument.reconstruction.job import job_from_calibration, job_from_files
from instrument.reconstruction.matching import check_pair
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.preparation import (
    Crop,
    auto_binning,
    bin_image,
    both_raw,
    check_psf,
    dark_from_corners,
    dark_from_file,
    erasures_of,
    reduce,
    reduce_valid,
    saturated_pixels,
)
from recon.arrays import Array
from recon.base.sloping_light import sloping_light
from recon.errors import InputError
from recon.types import Calibration, Geometry


def file(pixels: Array, name: str = "file.tif") -> ImageFile:
    return ImageFile(Path(name), pixels)


def psf_pixels(dtype: str = "uint16", offset: int = 34, shape: tuple[int, int] = (60, 80)) -> Array:
    psf = np.full(shape, offset, np.float64)
    psf[20:40, 30:50] += 100 * np.arange(20)
    return psf.astype(dtype)


@pytest.mark.parametrize(
    ("text", "window"),
    [
        ("1,2,3,4", (slice(1, 4), slice(2, 6))),
        ("10x20", (slice(25, 35), slice(30, 50))),
        (" 60 x 80 ", (slice(0, 60), slice(0, 80))),
    ],
)
def test_crops(text: str, window: tuple[slice, slice]) -> None:
    assert Crop.parse(text).slices((60, 80)) == window


@pytest.mark.parametrize("text", ["", "1,2,3", "axb", "-1,0,3,3", "0x5", "1,2,0,4", "1.5x2"])
def test_a_crop_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"write TOP|empty window"):
        Crop.parse(text)


@pytest.mark.parametrize("text", ["61x80", "60x81", "1,0,60,80", "0,70,10,11"])
def test_a_crop_outside_the_image_is_refused(text: str) -> None:
    with pytest.raises(BenchError, match="60 x 80"):
        Crop.parse(text).slices((60, 80))


def test_binning_is_the_mean_and_leaves_out_the_rest() -> None:
    image = np.arange(35, dtype=np.uint16).reshape(5, 7)
    binned = bin_image(image, 2)
    assert binned.dtype == np.float32
    assert binned.shape == (2, 3)
    assert binned[0, 0] == (0 + 1 + 7 + 8) / 4
    colour = np.stack([image, 2 * image, 3 * image], axis=-1)
    np.testing.assert_allclose(bin_image(colour, 2)[..., 2], 3 * binned)
    with pytest.raises(BenchError, match="--bin 6"):
        bin_image(image, 6)


def test_binning_leaves_something_to_decode() -> None:
    assert reduce(np.ones((64, 80)), 0.0, None, 8).shape == (8, 10)
    with pytest.raises(BenchError, match=r"--bin 30 leaves 2 x 2 of 64 x 80 pixels.*Take --bin 8 or less"):
        reduce(np.ones((64, 80)), 0.0, None, 30)
    assert reduce(np.ones((4, 4)), 0.0, None, 1).shape == (4, 4)


@pytest.mark.parametrize(("shape", "factor"), [((480, 640), 1), ((1200, 1600), 2), ((2160, 2560), 4)])
def test_automatic_binning(shape: tuple[int, int], factor: int) -> None:
    assert auto_binning(shape) == factor


def test_reduce_subtracts_first_and_keeps_negative_values() -> None:
    image = np.array([[10, 30], [30, 50], [9, 9]], np.uint16)
    tiled = np.vstack([np.tile(image[:2], (8, 8)), np.full((1, 16), 9, np.uint16)])
    assert reduce(tiled, 40.0, Crop(0, 0, 16, 16), 2).tolist() == [[-10.0] * 8] * 8
    dark = np.array([[10, 30], [30, 50], [0, 0]], np.float32)
    assert reduce(image, dark, Crop(0, 0, 2, 2), 1).tolist() == [[0, 0], [0, 0]]


def test_raw_frames_of_one_camera_share_the_offset_of_the_psfs_darkest_corner() -> None:
    psf, image = psf_pixels(), psf_pixels() + np.uint16(500)
    psf[:20, :20] += np.uint16(7)
    dark = dark_from_corners(file(psf), file(image))
    assert dark.image == dark.psf == 34
    assert "estimated" in dark.reason


def test_a_raw_frame_with_holes_is_raw_and_fractions_are_not() -> None:
    psf, image = psf_pixels(offset=100), psf_pixels(offset=100)
    image[:] = image + 500.0
    holes = image.astype(np.float32)
    holes[3, 4:9] = np.nan
    assert both_raw(file(psf), file(holes))
    assert dark_from_corners(file(psf), file(holes)).image == dark_from_corners(file(psf), file(image)).image
    for other in (image.astype(np.float32), holes + 0.5, holes / 1000 // 1, -holes):
        assert not both_raw(file(psf), file(other))
    assert not both_raw(file(psf.astype(np.float32)), file(image))


def test_a_float_psf_tells_nothing_about_the_images_offset() -> None:
    dark = dark_from_corners(file(psf_pixels("float32", 0) / 10), file(psf_pixels(offset=100)))
    assert (dark.image, dark.psf) == (100, 0)


def caustics(shape: tuple[int, int] = (120, 160)) -> Array:
    """A pattern of bright lines that fills its frame, counts."""
    rng = np.random.default_rng(2)
    return np.asarray(4000 * np.maximum(gaussian_filter(rng.standard_normal(shape), 3) * 10 - 1, 0))


def in_the_middle(pattern: Array) -> Array:
    return np.asarray(np.pad(pattern[30:90, 40:120], ((30, 30), (40, 40))))


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("colours", [1, 3])
def test_light_that_grows_across_a_psf_is_taken_off_it(times: int, colours: int) -> None:
    rng = np.random.default_rng(3)
    pattern = in_the_middle(caustics())
    slope = 40 + np.add.outer(2 * np.arange(120), 5 * np.arange(160)) / 2
    photograph = file(np.asarray(300 + 100 * rng.random((120 // times, 160 // times)), np.uint16))

    def prepared(light: Array | float) -> tuple[Array, str]:
        psf = np.repeat((pattern + light)[..., None], colours, axis=-1).squeeze()
        noise = 3 * rng.standard_normal(psf.shape)
        job = job_from_files(
            file(np.round(psf + noise).astype(np.uint16)), photograph, InputOptions(binning=2)
        )
        return job.calibration.psfs[0, 0], job.notes["Dark"]

    (clean, no_word), (levelled, told) = prepared(40.0), prepared(slope)
    assert np.abs(levelled - clean).mean() < 0.02 * clean.mean()
    grown = re.search(r"light that grows across it by (\d+) counts", told)
    assert grown is not None
    assert abs(int(grown[1]) - 516) <= 3
    assert "grows" not in no_word
    assert told.count("from the PSF") == 1  # its corner's level is not taken off beside it
    steep = prepared(40 + 20 * (slope - 40))[1]
    assert re.search(r"light that grows across it by 10\d{3} counts", steep)


@pytest.mark.parametrize(("before", "wide"), [(0, 100), (0, 80), (50, 150), (100, 200), (200, 300)])
@pytest.mark.parametrize("is_round", [False, True])
def test_a_broad_lobe_beside_the_middle_is_the_psfs_own(before: int, wide: int, is_round: bool) -> None:
    y, x = np.mgrid[:120.0, :160.0]
    far2 = (x + before) ** 2 + is_round * (y - 60) ** 2
    psf = in_the_middle(caustics()) + 3000 * np.exp(-far2 / 2 / wide**2) + 34
    psf += 3 * np.random.default_rng(0).standard_normal(psf.shape)
    assert sloping_light(psf) is None


@pytest.mark.parametrize("window", [np.s_[:, :], np.s_[30:, 40:], np.s_[:90, 20:140]])
def test_a_pattern_that_reaches_the_border_is_no_sloping_light(window: Any) -> None:
    whole = np.pad(caustics(), 20)[20:, 20:]
    brighter = whole * np.linspace(0.2, 1, whole.shape[1])
    psf = np.ascontiguousarray(brighter[window]).astype(np.uint16)
    assert isinstance(dark_from_corners(file(psf), file(psf)).psf, float)


def test_an_image_darker_than_the_psfs_corners_keeps_its_own_offset() -> None:
    dark = dark_from_corners(file(psf_pixels(offset=300)), file(psf_pixels(offset=20)))
    assert (dark.image, dark.psf) == (20, 300)


@pytest.mark.parametrize(
    ("psf", "image", "pattern"),
    [
        (psf_pixels(), psf_pixels(shape=(60, 90)), "both must have one shape"),
        (psf_pixels(), psf_pixels(shape=(80, 60)), "may be rotated"),
        (np.dstack([psf_pixels()] * 3), psf_pixels(), None),
        (psf_pixels(), psf_pixels()[::2, ::2], None),
        (psf_pixels()[::2, ::2], psf_pixels(), None),
        (psf_pixels(), psf_pixels()[::2], "a whole multiple"),
        (psf_pixels() // 20, psf_pixels(), None),
        ((psf_pixels() // 20).astype(np.uint8), psf_pixels(), "8 bit, but the image .* 16 bit"),
        (psf_pixels("float32"), psf_pixels(), None),
        (psf_pixels(), np.dstack([psf_pixels()] * 3), None),
    ],
)
def test_pairs(psf: Array, image: Array, pattern: str | None) -> None:
    if pattern is None:
        check_pair(file(psf), file(image))
    else:
        with pytest.raises(FileError, match=pattern):
            check_pair(file(psf), file(image))


def test_mixed_depth_is_accepted_when_meant() -> None:
    check_pair(file((psf_pixels() // 20).astype(np.uint8)), file(psf_pixels()), allow_mixed_depth=True)


@pytest.mark.parametrize(
    ("psf", "pattern"),
    [(np.zeros((9, 9), np.uint8), "empty"), (np.full((9, 9), 7, np.uint8), "every pixel is 7")],
)
def test_a_psf_without_content_is_refused(psf: Array, pattern: str) -> None:
    with pytest.raises(FileError, match=pattern):
        check_psf(file(psf))


@pytest.mark.parametrize("full_scale", [255, 1023, 4095, 65520, 65535])
def test_a_saturated_psf_is_refused_unless_allowed(full_scale: int) -> None:
    psf = np.minimum(psf_pixels(offset=0).astype(np.int64) * 40, full_scale).astype(np.uint16)
    with pytest.raises(FileError, match=rf"saturated \(at {full_scale}\).*shorter exposure"):
        check_psf(file(psf))
    assert "saturated" in check_psf(file(psf), allow_saturated=True)[0]


def test_columns_at_full_scale_are_called_defects() -> None:
    psf = psf_pixels().astype(np.uint16)
    psf[:, [7, 30]] = 65535
    with pytest.raises(FileError, match=r"columns 7, 30: defects of the sensor") as refused:
        check_psf(file(psf))
    assert "exposure, or" not in str(refused.value)
    row = psf_pixels().astype(np.uint16)
    row[12] = 65535
    with pytest.raises(FileError, match=r"row 12: defects"):
        check_psf(file(row))


def test_a_few_saturated_pixels_are_a_warning_and_a_single_bright_one_is_none() -> None:
    psf = psf_pixels().astype(np.uint16)
    psf[20, 30:32] = 4095
    psf[25:40, 30:50] = 3500
    (warning,) = check_psf(file(psf))
    assert warning.startswith("2 pixels")
    psf[20, 31] = 0
    assert not saturated_pixels(psf).any()


def test_job_from_files_says_what_was_chosen(tmp_path: Path) -> None:
    write_image(tmp_path / "psf.tif", psf_pixels())
    write_image(tmp_path / "raw.tif", psf_pixels(offset=134))
    job = job_from_files(
        tmp_path / "psf.tif", tmp_path / "raw.tif", InputOptions(crop=Crop.parse("40x40"), binning=2)
    )
    assert job.measurement.shape == (20, 20)
    assert job.calibration.psfs.shape == (1, 1, 20, 20)
    assert job.calibration.psfs.min() == 0
    assert "34.0 counts" in job.notes["Dark"]
    assert job.notes["Pixels"] == "window of 40 x 40, binned 2 x 2: 20 x 20"
    assert job.provenance["crop"] == {"top": 10, "left": 20, "height": 40, "width": 40}
    assert job.provenance["psf"]["path"] == str(tmp_path / "psf.tif")


def test_a_psf_that_vanishes_with_the_dark_is_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "psf.tif", psf_pixels())
    write_image(tmp_path / "raw.tif", psf_pixels())
    with pytest.raises(FileError, match="nothing of the PSF is left"):
        job_from_files(tmp_path / "psf.tif", tmp_path / "raw.tif", InputOptions(dark=60000.0))
    write_image(tmp_path / "dark.tif", np.zeros((9, 9), np.uint16))
    with pytest.raises(FileError, match=r"dark frame is 9 x 9"):
        job_from_files(tmp_path / "psf.tif", tmp_path / "raw.tif", InputOptions(dark=tmp_path / "dark.tif"))
    write_image(tmp_path / "dark.tif", np.zeros_like(psf_pixels(), np.uint8))
    with pytest.raises(FileError, match=r"the dark frame has 8 bit, but the image .* has 16 bit"):
        job_from_files(tmp_path / "psf.tif", tmp_path / "raw.tif", InputOptions(dark=tmp_path / "dark.tif"))


def test_an_image_is_binned_to_its_calibration(tmp_path: Path) -> None:
    psfs = np.stack([bin_image(psf_pixels(offset=0), 2)] * 2)[:, None]
    background = np.full((1, 30, 40), 34, np.float32)
    positions = np.array([[0, 0, 1e4], [0, 0, 2e4]], np.float64)
    calibration = Calibration(psfs, positions, background, Geometry(pixel_pitch_um=4.0))
    save_calibration(calibration, tmp_path / "demo" / "run" / "calibration")
    run, demo = tmp_path / "demo" / "run", tmp_path / "demo"
    assert find_calibration(demo) == find_calibration(run) == find_calibration(run / "calibration")
    write_image(tmp_path / "raw.tif", psf_pixels())
    job = job_from_calibration(run, tmp_path / "raw.tif", InputOptions(binning=2))
    assert job.measurement.shape == job.calibration.psfs.shape[-2:] == (15, 20)
    np.testing.assert_allclose(job.measurement, job.calibration.psfs[0, 0], atol=1e-3)
    assert job.calibration.geometry.pixel_pitch_um == 8.0
    write_image(tmp_path / "other.tif", psf_pixels(shape=(50, 80)))
    with pytest.raises(FileError, match="no whole binning"):
        job_from_calibration(run, tmp_path / "other.tif", InputOptions())
    save_calibration(calibration, tmp_path / "demo" / "second" / "calibration")
    with pytest.raises(FileError, match="holds 2 calibrations"):
        find_calibration(demo)


@pytest.mark.parametrize(("name", "pattern"), [("absent", "does not exist"), (".", "no calibration")])
def test_a_folder_without_a_calibration_is_refused(tmp_path: Path, name: str, pattern: str) -> None:
    write_image(tmp_path / "raw.tif", psf_pixels())
    with pytest.raises(FileError, match=pattern):
        job_from_calibration(tmp_path / name, tmp_path / "raw.tif", InputOptions())


def test_a_sweep_that_was_cut_short_is_named_as_what_can_go_on(tmp_path: Path) -> None:
    (tmp_path / "state.json").write_text("{}")
    with pytest.raises(FileError, match=f"holds no calibration.*resume {tmp_path}"):
        find_calibration(tmp_path)


def test_saturated_pixels_are_erased_when_asked_and_counted() -> None:
    image = psf_pixels()
    image[5, 5:8] = 4095
    erased = erasures_of("saturated", file(image))
    assert erased.valid is not None
    assert (~erased.valid).sum() == 3
    assert erased.reason.startswith("3 saturated pixels")
    assert erasures_of("none", file(image)).valid is None
    assert erasures_of("saturated", file(psf_pixels())).valid is None


def test_pixels_clipped_below_full_scale_are_erased_too_each_channel_at_its_own_maximum() -> None:
    rng = np.random.default_rng(3)
    scene = rng.integers(100, 900, (60, 80)).astype(np.uint16)
    clipped = np.minimum(scene, 800)
    for image in (clipped, clipped.astype(np.float32) - 34.5):
        erased = erasures_of("saturated", file(image))
        np.testing.assert_array_equal(erased.valid, scene < 800)
    colour = np.stack([clipped, clipped // 2, scene], axis=-1)
    valid = erasures_of("saturated", file(colour)).valid
    assert valid is not None
    np.testing.assert_array_equal(valid[..., 1], clipped // 2 < 400)
    assert valid[..., 2].all()
    assert check_psf(file(clipped))[0].startswith(f"{np.count_nonzero(scene >= 800)} pixels")  # not certain


def test_hot_and_dead_pixels_are_erased_unless_the_psf_has_spots_as_narrow() -> None:
    rng = np.random.default_rng(5)
    psf, scene = (gaussian_filter(rng.random((120, 160)), 2.5) for _ in range(2))
    psf = np.maximum(psf - psf.mean(), 0) * 1e6 + rng.normal(0, 50, psf.shape)
    image = 4000 + 2e5 * (scene - scene.mean()) + rng.normal(0, 20, scene.shape)
    planted = image.copy()
    planted[20, 30], planted[70, 80], planted[71, 80], planted[119, 0] = 60_000, 30_000, 30_000, -9000
    planted[50, 50] = np.nan
    odd = defective_pixels(planted, psf)
    assert np.argwhere(odd).tolist() == [[20, 30], [70, 80], [71, 80], [119, 0]]
    assert not defective_pixels(image, psf).any()
    spots = np.zeros(psf.shape)
    spots[rng.integers(0, 120, 30), rng.integers(0, 160, 30)] = 1.0
    assert not defective_pixels(planted, spots).any()
    erased = erasures_of(
        "saturated", file(np.nan_to_num(planted, nan=image[50, 50]).clip(0).astype(np.uint16)), psf
    )
    assert erased.reason == "4 hot or dead pixels; --erasures none uses them"
    holes = erasures_of("saturated", file(np.where(np.arange(160) == 5, np.nan, image).astype(np.float32)))
    assert holes.reason == "120 pixels that are NaN"
    one = np.where(np.arange(image.size).reshape(image.shape) == 5, np.nan, image).astype(np.float32)
    assert erasures_of("saturated", file(one)).reason == "1 pixel that is NaN"


def test_hot_and_dead_pixels_of_a_psf_are_filled_unless_they_are_its_spots() -> None:
    rng = np.random.default_rng(5)
    spread = gaussian_filter(rng.random((120, 160)), 2.5)
    psf = (100 + 4e5 * np.maximum(spread - spread.mean(), 0) + rng.normal(0, 50, spread.shape)).clip(0)
    psf = np.round(psf).astype(np.uint16)
    assert mended_psf(psf)[0] is psf
    hot = psf.copy()
    where = rng.choice(
        psf.size, 190, replace=False
    )  # ten times the tail by which a PSF's own pixels are known
    hot.flat[where] = 65535
    mended, count = mended_psf(hot)
    assert count > 0.8 * len(where)
    assert mended.dtype == psf.dtype
    assert np.mean(np.abs(mended - psf.astype(float))[mended != hot]) < 0.05 * psf.max()
    np.testing.assert_array_equal(mended[hot == psf], hot[hot == psf])
    colour, count_of_two = mended_psf(np.stack([hot, psf, hot], axis=-1))
    np.testing.assert_array_equal(colour[..., 2], mended)
    assert count_of_two == 2 * count
    spots = np.zeros(psf.shape, np.uint16)
    spots[rng.integers(0, 120, 30), rng.integers(0, 160, 30)] = 60_000
    assert mended_psf(spots)[1] == 0
    for seed in range(4):  # what is left of a pinhole's PSF is noise, spread out and of any sum
        pinhole = np.random.default_rng(seed).normal(100, 5, psf.shape)
        pinhole[60, 80] = 30_000
        assert mended_psf(pinhole)[1] == 0


def test_a_defect_stays_where_it_is_at_all_depths_and_a_focus_is_at_one() -> None:
    rng = np.random.default_rng(6)
    stack = np.stack([100 * gaussian_filter(rng.random((60, 80)), 2.0) for _ in range(5)])
    stack[2, 20, 30] += 90
    assert mended_stack(stack)[0] is stack
    hot = stack.copy()
    hot[:, 40, 50] += 90
    mended, count = mended_stack(hot)
    assert count == 5
    np.testing.assert_array_equal((mended != hot).sum(axis=(1, 2)), 1)
    assert mended_psf(stack[2])[1] == 1, "which one depth alone cannot tell"


def test_a_share_is_erased_at_random_and_the_same_every_time() -> None:
    first, again = (erasures_of(0.8, file(psf_pixels())).valid for _ in range(2))
    assert first is not None
    assert again is not None
    assert 0.75 < 1 - first.mean() < 0.85
    np.testing.assert_array_equal(first, again)
    for share in (1.0, -0.1, float("nan")):
        with pytest.raises(BenchError, match="from 0 to below 1"):
            erasures_of(share, file(psf_pixels()))


def test_a_mask_erases_where_it_is_zero(tmp_path: Path) -> None:
    mask = np.ones((60, 80), np.uint8)
    mask[:10] = 0
    write_image(tmp_path / "mask.png", mask)
    valid = erasures_of(tmp_path / "mask.png", file(psf_pixels())).valid
    np.testing.assert_array_equal(valid, mask == 1)
    write_image(tmp_path / "mask.png", 0 * mask)
    with pytest.raises(FileError, match="no pixel is left"):
        erasures_of(tmp_path / "mask.png", file(psf_pixels()))
    with pytest.raises(FileError, match="the mask is 60 x 80"):
        erasures_of(tmp_path / "mask.png", file(psf_pixels(shape=(50, 80))))


def test_a_binned_pixel_is_valid_where_all_of_its_pixels_are() -> None:
    valid = np.ones((5, 6), bool)
    valid[1, 2] = False
    assert reduce_valid(valid, None, 2).tolist() == [[True, False, True], [True, True, True]]
    assert reduce_valid(valid, Crop(2, 0, 2, 4), 2).all()


def test_a_dark_frame_with_light_is_told() -> None:
    rng = np.random.default_rng(0)
    light = rng.poisson(100 + 400 * rng.random((1, 64)) * np.ones((48, 1))).astype(np.uint16)
    image = ImageFile(Path("photo.tif"), light)
    dark = ImageFile(Path("dark.tif"), rng.poisson(100, (48, 64)).astype(np.uint16))
    unlit = ImageFile(Path("unlit.tif"), rng.poisson(100, (48, 64)).astype(np.uint16))
    lit = ImageFile(Path("lit.tif"), np.roll(light, 32, axis=1))
    for photograph in (image, unlit):
        assert "BRIGHTER" not in dark_from_file(dark, photograph).reason
    assert "BRIGHTER than the photograph: was there light?" in dark_from_file(lit, image).reason
