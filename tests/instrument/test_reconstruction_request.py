"""Pictures and volumes as requests: what the command line, the window and scripts fill in."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError
from instrument.files.images import read_stack
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.request import PictureRequest, VolumeRequest, volume_job
from instrument.reconstruction.stored_result import open_result
from instrument.volumes.writing import write_volume_tiff, write_volume_zarr
from recon.camera.grid import Grid
from recon.errors import InputError
from recon.reconstruction.options import Overrides, ReconstructionOptions
from recon.types import Calibration

SIZE = 48


@pytest.fixture
def psf():
    rng = np.random.default_rng(0)
    image = np.zeros((SIZE, SIZE))
    image[rng.integers(8, SIZE - 8, 12), rng.integers(8, SIZE - 8, 12)] = 1
    return fftconvolve(image, np.ones((2, 2)) / 4, "same").clip(0)


@pytest.fixture
def photograph(psf):
    scene = np.zeros((SIZE, SIZE))
    scene[20:26, 18:30] = 1
    light = 500 * np.clip(fftconvolve(scene, psf, "same"), 0, None) + 100
    return np.random.default_rng(1).poisson(light).astype(np.uint16)


@pytest.fixture
def picture_files(tmp_path, psf, photograph):
    tifffile.imwrite(tmp_path / "psf.tif", (3000 * psf / psf.max()).astype(np.uint16))
    tifffile.imwrite(tmp_path / "raw.tif", photograph)
    return {"psf": tmp_path / "psf.tif", "image": tmp_path / "raw.tif"}


@pytest.fixture
def volume_files(tmp_path, psf, photograph):
    stack = np.stack([(3000 * np.roll(psf, z, 0)).astype(np.uint16) for z in range(2)])
    tifffile.imwrite(tmp_path / "psfs.tif", stack)
    tifffile.imwrite(tmp_path / "raw.tif", photograph)
    return {"psfs": tmp_path / "psfs.tif", "image": tmp_path / "raw.tif"}


def decision(choice, name):
    return next(d for d in choice.decisions if d.name == name)


def test_a_raw_frame_of_a_mosaic_is_reconstructed_unmerged(picture_files):
    raw = InputOptions(mosaic="RGGB")
    request = PictureRequest(**picture_files, inputs=raw, options=ReconstructionOptions(iterations=5))
    result = request.solve(request.prepare())
    assert result.image.shape == (SIZE, SIZE, 3)
    assert np.isfinite(result.image).all()
    channels = decision(result.choice, "channels")
    assert channels.value == "all 3"
    assert "only 0 of 2304 pixels tell all colours" in channels.why
    assert not request.explain(request.prepare()).merged
    wished = ReconstructionOptions(choose=Overrides(channels="merged"))
    merged = PictureRequest(**picture_files, inputs=raw, options=wished)
    with pytest.raises(InputError, match="cannot be merged"):
        merged.solve(merged.prepare())


def test_a_positive_background_needs_no_other_word(volume_files):
    options = ReconstructionOptions(iterations=2, positive_background=True)
    request = VolumeRequest(**volume_files, options=options)
    job = request.prepare()
    solved = request.solve(job).choice
    explained = request.explain(job)
    assert solved.background
    assert decision(explained, "background").value == decision(solved, "background").value == "estimated"
    assert decision(explained, "background").overruled
    with pytest.raises(BenchError, match="exclude each other"):
        VolumeRequest(**volume_files, options=replace(options, estimate_background=False)).prepare()


def test_the_tolerance_that_was_asked_for_is_explained_and_kept(picture_files, volume_files):
    options = ReconstructionOptions(iterations=2, tolerance=3e-2)
    for request in (
        PictureRequest(**picture_files, options=options),
        VolumeRequest(**volume_files, options=options),
    ):
        job = request.prepare()
        for choice in (request.explain(job), request.solve(job).choice):
            assert choice.tolerance == 3e-2
            assert decision(choice, "iterations").overruled


@pytest.mark.parametrize("model", ["auto", "convolution"])
def test_the_precision_that_was_asked_for_is_computed_in(picture_files, volume_files, model):
    for precision in ("float64", "auto"):
        options = ReconstructionOptions(model=model, precision=precision, iterations=2)
        for request in (
            PictureRequest(**picture_files, options=options),
            VolumeRequest(**volume_files, options=options),
        ):
            job = request.prepare()
            result = request.solve(job)
            expected = "float32" if precision == "auto" else precision
            assert result.provenance["precision"] == expected
            if model == "auto":
                assert request.explain(job).precision == expected
                assert decision(result.choice, "precision").overruled == (precision != "auto")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--precision", "double"], "--precision must be one of auto, float32, float64"),
        (["--precision", "float64", "--choose", "precision=float32"], "the same twice"),
        (["--precision", "float64", "--video"], "do not apply: --precision (for a picture"),
    ],
)
def test_a_precision_that_is_not_understood_is_refused(picture_files, capsys, arguments, said):
    assert main(["reconstruct", "--psf", str(picture_files["psf"]), *arguments]) == 2
    assert said in capsys.readouterr().err


def test_a_picture_of_one_convolution_says_the_field_and_the_end_that_it_has(picture_files):
    request = PictureRequest(**picture_files)
    result = request.solve(request.prepare())
    choice = result.choice
    assert (choice.model, choice.background) == ("convolution", False)
    assert decision(choice, "field").value == f"{2 * SIZE - 1} x {2 * SIZE - 1} pixels"
    assert choice.psf_window == (SIZE, SIZE)
    assert choice.acceptance_px is None


def test_wishes_are_refused_where_a_model_was_asked_for(picture_files, volume_files):
    asked = ReconstructionOptions(model="convolution", choose=Overrides(binning=2))
    for request in (
        PictureRequest(**picture_files, options=asked),
        VolumeRequest(**volume_files, options=asked),
    ):
        with pytest.raises(BenchError, match=r"--choose .* with --model convolution"):
            request.prepare()
        plain = replace(request, options=ReconstructionOptions(model="convolution"))
        with pytest.raises(BenchError, match=r"--explain .* with --model convolution"):
            plain.explain(plain.prepare())


@pytest.mark.parametrize("option", ["--explain", "--choose=binning=1"])
def test_a_checkpoint_leaves_everything_to_choose(picture_files, option, tmp_path, capsys):
    files = ["--psf", str(picture_files["psf"]), "--image", str(picture_files["image"])]
    out = ["--out", str(tmp_path / "out.tif"), "-n", "2"]
    assert main(["reconstruct", *files, *out, option, "--checkpoint", str(tmp_path / "kept")]) == 0
    assert "Binning" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tau": -1.0}, "tau must be"),
        ({"iterations": 0}, "iterations must be a whole number"),
        ({"tolerance": -1.0}, "tolerance must be"),
        ({"prior": "tb"}, "prior must be one of tv.*not 'tb'"),
        ({"z_um": -5e3}, r"z_um must be a number, above 0 \(um\), or inf, not -5000"),
        ({"inputs": InputOptions(noise=-1.0)}, "noise must be"),
    ],
)
def test_options_are_checked_before_any_file_is_read(tmp_path, changes, said):
    missing = {"image": tmp_path / "none.tif", "psf": tmp_path / "none too.tif"}
    changes = dict(changes)
    inputs = changes.pop("inputs", InputOptions())
    with pytest.raises((InputError, BenchError), match=said):
        PictureRequest(**missing, inputs=inputs, options=ReconstructionOptions(**changes)).prepare()


@pytest.mark.parametrize("kind", ["names", "OME-TIFF", "OME-Zarr"])
def test_depths_of_psf_files_come_as_far_as_the_metric_volume(tmp_path, photograph, psf, kind, capsys):
    z_mm, stack = (10.0, 12.5, 16.0), np.stack([np.roll(psf, z, 0) for z in range(3)])
    if kind == "names":
        (tmp_path / "psfs").mkdir()
        for z, own in zip(z_mm, stack, strict=True):
            tifffile.imwrite(tmp_path / "psfs" / f"z{z:g}mm.tif", own.astype(np.float32))
        psfs = tmp_path / "psfs"
    else:
        psfs = tmp_path / ("psfs.ome.tif" if kind == "OME-TIFF" else "psfs.ome.zarr")
        z_um = 1e3 * np.array(z_mm if kind == "OME-TIFF" else (10.0, 13.0, 16.0))
        grid = Grid(stack.shape, (24, 24), z_um, np.full(3, 6.5))
        write = write_volume_tiff if kind == "OME-TIFF" else partial(write_volume_zarr, attributes={})
        write(psfs, iter(stack.astype(np.float32)), stack.shape, grid)
        z_mm = z_um / 1e3
    tifffile.imwrite(tmp_path / "raw.tif", photograph)
    words = ["reconstruct", "--volume", str(psfs), "--image", str(tmp_path / "raw.tif"), "--iterations", "2"]
    words += ["--model", "convolution", "--prior", "l1"]
    optics = ["--distance-mm", "6", *(["--pixel-um", "6.5"] if kind == "names" else [])]
    assert main([*words, *optics, "--out", str(tmp_path / "v.ome.zarr")]) == 0
    said = capsys.readouterr().out
    assert "taken for distances from the diffuser" in said
    assert ("pixels of 6.5 um as it says" in said) == (kind != "names")
    grid = open_result(tmp_path / "v.ome.zarr").grid
    np.testing.assert_allclose(grid.z_um, 1e3 * np.array(z_mm))
    np.testing.assert_allclose(grid.pitch_um, 6.5 * np.array(z_mm) / 6)
    assert main(["export", str(tmp_path / "v.ome.zarr"), str(tmp_path / "m.ome.zarr"), "--metric"]) == 0
    assert open_result(tmp_path / "m.ome.zarr").grid.z_um[0] == pytest.approx(1e4)


@pytest.mark.parametrize("depths_um", [[0.0, 500.0], [700.0, 700.0], ["x", 3], [500.0, float("nan")]])
def test_depths_that_are_no_distances_from_the_diffuser_are_not_taken(volume_files, depths_um):
    stack = replace(read_stack(volume_files["psfs"]), metadata={"depths_um": depths_um})
    job = volume_job(stack, volume_files["image"], InputOptions(distance_mm=6.0))
    assert np.isnan(job.calibration.source_positions_um).all()
    assert "taken for no distances" in job.notes["PSFs"]


@pytest.mark.parametrize(("mosaic", "filled"), [(None, True), ("RGGB", False)])
def test_psfs_under_a_mosaic_are_not_looked_through_for_hot_pixels(tmp_path, mosaic, filled):
    """Its neighbours in a raw frame saw other colours (decision 0259)."""
    rng = np.random.default_rng(6)
    stack = np.stack([100 * gaussian_filter(rng.random((60, 80)), 2.0) for _ in range(5)])
    stack[:, 40, 50] += 90
    tifffile.imwrite(tmp_path / "psfs.tif", stack.astype(np.float32))
    tifffile.imwrite(tmp_path / "raw.tif", rng.poisson(500, (60, 80)).astype(np.uint16))
    inputs = InputOptions(mosaic=mosaic)
    job = volume_job(tmp_path / "psfs.tif", tmp_path / "raw.tif", inputs)
    assert ("filled" in job.notes.get("PSFs", "")) == filled


def test_a_calibration_says_its_own_optics(tmp_path, psf, photograph):
    calibration = Calibration(np.float32(psf)[None, None].repeat(2, 0), np.array([(0, 0, 1e4), (0, 0, 2e4)]))
    save_calibration(calibration, tmp_path / "calibration")
    tifffile.imwrite(tmp_path / "raw.tif", photograph)
    with pytest.raises(BenchError, match="says its own"):
        volume_job(tmp_path / "calibration", tmp_path / "raw.tif", InputOptions(pixel_um=6.5))
