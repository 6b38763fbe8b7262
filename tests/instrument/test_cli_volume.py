"""``diffuserbench reconstruct --volume`` from files to files."""

import json

import numpy as np
import pytest
import tifffile

from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from recon import Calibration, Geometry

SIZE, DEPTHS, OFFSET = 32, 4, 100


def psf(z):
    """Spots of random lenslets, further apart the nearer the plane."""
    lenses = np.random.default_rng(0).uniform(-9, 9, (12, 2))
    image = np.zeros((SIZE, SIZE), np.float32)
    rows, columns = np.round(lenses * (1 + 0.15 * z) + SIZE // 2).astype(int).T
    np.add.at(image, (rows, columns), 200)
    return image


@pytest.fixture
def files(tmp_path):
    folder = tmp_path / "psfs"
    folder.mkdir()
    for z in range(DEPTHS):
        tifffile.imwrite(folder / f"psf{z}.tif", psf(z))
    photograph = 3 * np.roll(psf(2), (4, -3), (0, 1)) + OFFSET
    photograph += np.random.default_rng(1).normal(0, 2, photograph.shape)
    tifffile.imwrite(folder / "image.tif", photograph.astype(np.uint16))
    return folder, folder / "image.tif", tmp_path / "volume.tif"


@pytest.fixture
def run(capsys):
    def call(*arguments):
        code = main(["reconstruct", *map(str, arguments)])
        output = capsys.readouterr()
        return code, " ".join((output.out + output.err).split())

    return call


def test_writes_volume_views_and_record(files, run):
    folder, image, out = files
    code, output = run("--volume", folder, "--image", image, "--dark", OFFSET, "--prior", "l1", "--out", out)
    assert code == 0, output
    assert "Planes 3 of 4" in output
    assert "Model " not in output  # one PSF a depth: nothing to decide
    with tifffile.TiffFile(out) as tiff:
        assert tiff.is_ome
        assert tiff.series[0].axes == "ZYX"
        volume = tiff.asarray()
    assert np.unravel_index(volume.argmax(), volume.shape) == (2, SIZE // 2 + 4, SIZE // 2 - 3)
    record = json.loads(out.with_suffix(".json").read_text())
    assert record["model"] == "convolution"
    assert record["background_estimated"] is False  # the photograph has no stray light
    assert record["grid"]["shape"] == [DEPTHS, SIZE, SIZE]
    assert out.with_suffix(".png").stat().st_size > 10_000


def test_voxel_sizes_of_a_calibration_reach_the_file(files, tmp_path, run):
    _, image, out = files
    z_um = np.array([9000.0, 10000.0, 11000.0, 12000.0])
    positions = np.stack([0 * z_um, 0 * z_um, z_um], axis=1)
    psfs = np.stack([psf(z)[None] for z in range(DEPTHS)])
    save_calibration(Calibration(psfs, positions, geometry=Geometry(10.0, 5.0)), tmp_path / "calibration")
    code, output = run(
        "--volume", tmp_path / "calibration", "-i", image, "--dark", OFFSET, "-n", 3, "-o", out
    )
    assert code == 0, output
    with tifffile.TiffFile(out) as tiff:
        assert 'PhysicalSizeX="22.0"' in tiff.ome_metadata
        assert 'PhysicalSizeZ="1000.0"' in tiff.ome_metadata
    assert json.loads(out.with_suffix(".json").read_text())["grid"]["z_um"] == z_um.tolist()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--model", "exact"], "--model must be one of auto, convolution"),
        (["--model", "local"], "several places of the field"),
        (["--prior", "tv-haar"], "not for volumes"),
        (["--z-mm", "3"], "do not apply"),
        (["--noise", "loud"], "--noise 'loud': write a standard deviation"),
        (["--noise", "1,2,3"], "read noise in counts"),
        (["--noise=-1"], "standard deviation in counts"),
        (["--memory", "0.00001"], "Bin the images or take fewer depths"),
    ],
)
def test_refuses_in_words(files, arguments, words, run):
    folder, image, out = files
    code, output = run("--volume", folder, "--image", image, "--out", out, "-n", "1", *arguments)
    assert code == 2
    assert words in output
    assert not out.exists()


@pytest.mark.parametrize("options", [("--rotate", "180"), ("--allow-saturated",), ("--mixed-depth",)])
def test_an_option_for_pictures_is_refused_not_ignored(files, run, options):
    folder, image, out = files
    code, output = run("--volume", folder, "--image", image, "--out", out, *options)
    assert code == 2
    assert f"With --volume these do not apply: {options[0]} (for a picture" in output
    assert not out.exists()


def test_noise_is_passed_on_and_reduced_by_binning(files, run):
    folder, image, out = files
    common = ("--volume", folder, "--image", image, "--out", out, "-n", "1", "--force")
    assert run(*common, "--noise", "8")[0] == 0
    assert json.loads(out.with_suffix(".json").read_text())["provenance"]["noise_deviation"] == [8.0]
    assert run(*common, "--noise", "8", "--bin", "2")[0] == 0
    assert json.loads(out.with_suffix(".json").read_text())["provenance"]["noise_deviation"] == [4.0]


@pytest.mark.parametrize(
    "option", [("--scratch", "."), ("--memory", "4"), ("--background",), ("--no-background",)]
)
def test_memory_and_background_are_asked_for_in_pictures_too(files, run, option):
    folder, image, out = files
    code, output = run("--psf", folder / "psf0.tif", "--image", image, "--out", out, "-n", "2", *option)
    assert code == 0, output


def test_a_solver_that_does_not_take_volumes_says_so(files, run):
    folder, image, out = files
    code, output = run("--volume", folder, "--image", image, "--out", out, "--solver", "admm-sensor")
    assert code == 2
    assert "The solver admm-sensor does not take this: it is for one depth." in output


def test_a_picture_with_the_local_model(tmp_path, run):
    """From a calibration over the field to a picture; the response falls off towards the edge (Eq. 5.1)."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2

    def seen(row, column):
        response = np.exp(-((y + row) ** 2 + (x + column) ** 2) / (2 * 14.0**2))
        return np.roll(psf(1), (row, column), (0, 1)) * response

    z_um, pitch_um, distance_mm = 10_000.0, 10.0, 5.0
    scale = -pitch_um * z_um / (1000 * distance_mm)
    places = [(r, c) for r in (-6, 0, 6) for c in (-6, 0, 6)]
    psfs = np.stack([seen(r, c)[None] for r, c in places]).astype(np.float32)
    positions = np.array([(c * scale, r * scale, z_um + r / 2) for r, c in places])
    calibration = Calibration(psfs, positions, geometry=Geometry(pitch_um, distance_mm))
    save_calibration(calibration, tmp_path / "calibration")
    photograph = 5 * seen(4, -3) + np.random.default_rng(1).normal(OFFSET, 2, (SIZE, SIZE))
    image, out = tmp_path / "image.tif", tmp_path / "picture.tif"
    tifffile.imwrite(image, photograph.astype(np.uint16))
    common = ("--calibration", tmp_path / "calibration", "--image", image, "--dark", OFFSET, "--prior", "l1")
    code, output = run(*common, "--model", "local", "--noise", 2, "--out", out)
    assert code == 0, output
    assert "Model local: as asked" in output
    picture = tifffile.imread(out)
    assert picture.shape == (SIZE, SIZE)
    assert np.unravel_index(picture.argmax(), picture.shape) == (SIZE // 2 + 4, SIZE // 2 - 3)
    record = json.loads(out.with_suffix(".json").read_text())
    assert record["provenance"]["model"] == "local"
    assert record["provenance"]["noise_deviation"] == [2.0]


def test_simulated_volumes_are_called_so(files, run, tmp_path):
    _, image, out = files
    stack = np.stack([psf(z) for z in range(DEPTHS)])[:, None]
    positions = np.stack([np.zeros(DEPTHS), np.zeros(DEPTHS), np.linspace(9e3, 12e3, DEPTHS)], axis=1)
    simulated = Calibration(stack, positions, None, Geometry(), provenance={"simulated": True})
    save_calibration(simulated, tmp_path / "calibration")
    code, output = run("--volume", tmp_path / "calibration", "--image", image, "--out", out, "-n", 2)
    assert code == 0, output
    assert "SIMULATED" in output


def test_a_name_that_ends_in_ome_zarr_writes_that(files, run):
    import zarr

    folder, image, out = files
    out = out.with_name("volume.ome.zarr")
    arguments = ("--volume", folder, "--image", image, "--dark", OFFSET, "--prior", "l1", "--out", out)
    code, output = run(*arguments)
    assert code == 0, output
    volume = zarr.open_group(out, mode="r")["0"][...]
    assert np.unravel_index(volume.argmax(), volume.shape) == (2, SIZE // 2 + 4, SIZE // 2 - 3)
    assert out.with_name("volume.json").exists()
    code, output = run(*arguments)
    assert code == 2
    assert "exists already" in output
    assert run(*arguments, "--force")[0] == 0


def test_what_volumes_are_asked_for_pictures_are_asked_for_as_well(files, run):
    """A device, a background, a limit of memory: one path takes them all."""
    folder, image, out = files
    common = ("--psf", folder / "psf0.tif", "--image", image, "--out", out, "-n", "2", "--force")
    assert run(*common, "--background", "--model", "convolution")[0] == 0
    assert json.loads(out.with_suffix(".json").read_text())["background_estimated"]
    assert run(*common, "--memory", "4")[0] == 0
    code, output = run(*common, "--memory", "0.00001")
    assert code == 2
    assert "Bin the images" in output
    code, output = run(*common, "--method", "admm-gpu")
    assert code == 2
    assert "--device gpu" in output
