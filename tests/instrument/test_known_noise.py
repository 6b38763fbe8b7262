"""Noise that a photograph's metadata tell, on its way to the reconstruction."""

import numpy as np
import pytest

from instrument.bench.bench import open_bench
from instrument.bench.config_file import load_config
from instrument.cli import main
from instrument.files.images import ImageFile, read_image, write_image
from instrument.reconstruction.job import Job, noise_of
from recon import Calibration, NoiseModel

FACTS = {"noise": {"read_noise_counts": 3.0, "counts_per_electron": 0.2}}


def photograph(**facts):
    return ImageFile("a.tif", np.zeros((4, 4), np.uint16), metadata=facts)


def test_a_mean_of_frames_has_less():
    assert noise_of(photograph(**FACTS)) == NoiseModel(3.0, 0.2)
    assert noise_of(photograph(**FACTS, average=4)) == NoiseModel(1.5, 0.05)


@pytest.mark.parametrize(
    "facts",
    [
        {},
        {"noise": None},
        {"noise": "little"},
        {"noise": {"read_noise_counts": "x"}},
        {**FACTS, "average": 0},
    ],
)
def test_metadata_of_others_tell_nothing(facts):
    assert noise_of(photograph(**facts)) is None


def test_what_is_given_goes_before_what_is_known():
    image = np.zeros((4, 4), np.float32)
    calibration = Calibration(np.ones((1, 1, 4, 4), np.float32), np.zeros((1, 3)))
    job = Job(image, calibration, {}, provenance={"binning": 2}, known_noise=NoiseModel(3.0, 0.2))
    assert job.binned_noise(None) == NoiseModel(1.5, 0.05)
    assert job.binned_noise(5.0) == 2.5
    assert job.binned_noise("estimate") is None
    mosaic = Job(
        image, calibration, {}, provenance={"binning": 2, "mosaic": "RGGB"}, known_noise=NoiseModel(3.0, 0.2)
    )
    assert mosaic.binned_noise(None) == NoiseModel(3.0, 0.2)


def test_the_simulated_camera_tells_what_its_frames_show(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # no bench.toml: the built-in bench
    with open_bench(load_config(None)) as bench:
        known = bench.camera.noise
        bench.source_off()
        bench.scene_off()
        frames = [bench.snap(1).image[:400, :400].astype(float) for _ in range(2)]
    assert known is not None
    # Of the difference of two frames, so that the sensor's fixed pattern falls out.
    shown = np.median(np.abs(frames[0] - frames[1])) / 0.6745 / np.sqrt(2)
    assert known.read_noise_counts == pytest.approx(shown, rel=0.5)


def test_it_reaches_the_reconstruction(tmp_path, capsys):
    rng = np.random.default_rng(0)
    psf = np.where(rng.random((24, 24)) > 0.95, 900, 0).astype(np.uint16)
    write_image(tmp_path / "psf.tif", psf)
    write_image(
        tmp_path / "raw.tif", np.roll(psf, 2, 0) + rng.integers(0, 9, psf.shape).astype(np.uint16), FACTS
    )
    assert read_image(tmp_path / "raw.tif").metadata["noise"] == FACTS["noise"]
    arguments = ["-p", tmp_path / "psf.tif", "-i", tmp_path / "raw.tif", "--dark", 0, "-n", 2]
    assert main(["reconstruct", *map(str, arguments), "-o", str(tmp_path / "a.tif")]) == 0
    assert (
        "read noise 3 counts, 0.2 counts an electron, as the photograph's metadata say"
        in capsys.readouterr().out
    )
