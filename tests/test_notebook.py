"""``import diffuserbench as db``: light, complete, and its results show and save themselves."""

from __future__ import annotations

import inspect
import multiprocessing
import os
import subprocess
import sys
import threading
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import diffuserbench as db
from instrument.bench.config_file import template
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError
from instrument.files.images import ImageFile, write_image
from instrument.notebook.hologram import _depths
from instrument.notebook.reconstruct import require_hooks
from instrument.notebook.words import in_python
from recon.base.declare import options_of
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.reconstruction.options import ReconstructionOptions
from recon.types import Calibration
from tests.mocks.recordings import write_recording
from tests.test_tutorials import code_of

ROOT = Path(__file__).parents[1]
OFFSET = 30


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray]:
    """A photograph and its PSF, raw: 16 bit with a camera's offset."""
    made = make_scene("sparse-picture", size=48)
    photo, psf = np.asarray(made.measurement), made.calibration.psfs[0, 0]
    return tuple((OFFSET + 40_000 * image / image.max()).astype(np.uint16) for image in (photo, psf))


def plain(scene: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return tuple(image.astype(np.float32) - OFFSET for image in scene)


def test_the_import_is_light_and_every_name_exists() -> None:
    light = "import sys, diffuserbench; assert not {'numpy', 'recon.types'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", light], check=True, cwd=ROOT)
    for name in dir(db):
        assert getattr(db, name) is not None, name
    with pytest.raises(AttributeError, match="Did you mean 'reconstruct'"):
        db.reconstuct  # noqa: B018


def test_the_ten_lines_of_the_readme_run(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, image in zip(("photo.tif", "psf.tif"), scene, strict=True):
        db.write_image(name, image)
    with pytest.warns(UserWarning, match="no screen"):
        exec(compile(code_of(ROOT / "README.md"), "README.md", "exec"), names := {})
    assert (tmp_path / "scene.png").exists()
    with pytest.warns(UserWarning, match="no screen"):
        db.show("photo.tif")
    with pytest.raises(db.BenchError, match=r"holds 5 images; .* their mean\.$"):
        db.show(ImageFile(Path("films.tif"), np.zeros((5, 9, 9), np.uint8)))
    assert "counts from both" in names["tv"].job.notes["Dark"]
    assert names["tv"].image.shape == (48, 48)
    np.testing.assert_array_equal(np.asarray(names["tv"]), names["tv"].image)
    assert names["l1"].prior == "l1"
    facts = names["tv"].facts()
    assert "a frame or counts may be given by `dark`" in facts["Dark"]
    assert not [text for text in facts.values() if "--" in text], "the terminal's flags"


def test_a_result_shows_draws_and_saves_itself(scene: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    found = db.reconstruct(*plain(scene), iterations=5)
    assert repr(found).startswith("<Picture 48 x 48 by admm, prior tv: 5 iterations")
    page = found._repr_html_()
    assert "data:image/png;base64" in page
    assert "Verdict" in page
    with pytest.raises(AttributeError, match=r"no attribute 'sav'\. Did you mean 'save'"):
        found.sav  # noqa: B018
    with pytest.raises(db.BenchError, match="plot draws into Matplotlib axes"):
        found.plot("scene.png")
    axes = found.plot(rotate_deg=180)
    assert axes.images[0].get_array().shape == (48, 48)
    for name in ("a.npy", "a.png", "b.tif"):
        assert all(path.exists() for path in found.save(tmp_path / name))
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), found.image)
    with pytest.raises(db.FileError, match="exists already"):
        found.save(tmp_path / "a.npy")
    with pytest.raises(db.FileError, match="exists already"):
        found.save(tmp_path / "c.npy", figure=tmp_path / "a.png")
    with pytest.raises(db.BenchError, match="a multiple of 90"):
        found.save(tmp_path / "c.npy", rotate_deg=45)
    assert not (tmp_path / "c.npy").exists()
    opened = db.open_result(tmp_path / "b.tif")
    assert opened.facts()
    assert repr(opened).startswith(f"<{tmp_path / 'b.tif'}: 48 x 48 pixels")


def test_what_it_takes_is_told_before_as_the_terminal_tells_it(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    told = db.forecast(*plain(scene), iterations=20, tolerance=0.0, judged=False)
    assert (told.settles, told.counted) == (20, True)
    assert told.seconds > 0
    assert " ms an iteration, 20 of them" in repr(told)
    for name, image in zip(("photo.tif", "psf.tif"), scene, strict=True):
        write_image(tmp_path / name, image)
    files = tmp_path / "photo.tif", tmp_path / "psf.tif"
    assert db.forecast(*files, iterations=20, tolerance=0.0, binning=2).settles == 20
    assert {"binning", "prior", "z_um"} <= set(inspect.signature(db.forecast).parameters)
    with pytest.raises(InputError, match=r"no option 'itterations'.* mean 'iterations'"):
        db.forecast(*files, itterations=3)
    shown = db.forecast_hologram("portrait", "display", slm=(32, 32), iterations=3)
    assert " ms an iteration, 3 of them" in str(shown)


def test_what_a_recordings_film_takes_is_told_and_nothing_of_it_is_left(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    photo, psf = scene
    recorded = write_recording(tmp_path, {n: photo // (n + 1) for n in range(3)})
    write_image(tmp_path / "psf.tif", psf)
    save_calibration(
        Calibration(plain(scene)[1][None, None], np.full((1, 3), np.nan)), tmp_path / "calibration"
    )
    lying = set(tmp_path.rglob("*"))
    for run, place, options in (
        (recorded, tmp_path / "psf.tif", {"over_time": "tv", "block": 2}),
        (db.run(recorded), str(tmp_path / "calibration"), {"warm_iterations": 1}),
    ):
        told = db.forecast(run, place, iterations=2, model="convolution", film=False, **options)
        assert (told.settles, told.each, told.counted) == (3, "frame", True)
        assert told.seconds > 0
    assert set(tmp_path.rglob("*")) == lying
    with pytest.raises(BenchError, match="warm_iterations: for a video, not for a patterned picture"):
        db.forecast(recorded, place, patterned=recorded, warm_iterations=1)
    with pytest.raises(BenchError, match="by its file, or by its calibration's folder, not ndarray"):
        db.forecast(recorded, psf)
    with pytest.raises(BenchError, match=r"a run of 3 frames: .* --video makes its film"):
        db.reconstruct(recorded, place)


def test_light_that_falls_off_is_given_to_arrays_and_files(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    photo, psf = plain(scene)
    shade = np.linspace(0.4, 1.0, photo.size).reshape(photo.shape).astype(np.float32)
    options = {"iterations": 3, "judged": False, "model": "convolution"}
    expected = db.reconstruct(photo, psf, **options)
    np.testing.assert_allclose(
        db.reconstruct(photo * shade, psf, vignetting=shade, **options).image, expected.image, rtol=1e-3
    )
    write_image(tmp_path / "photo.tif", np.kron(photo * shade, np.ones((2, 2), np.float32)))
    write_image(tmp_path / "psf.tif", np.kron(psf, np.ones((2, 2), np.float32)))
    flat = np.kron(np.round(60_000 * shade), np.ones((2, 2))).astype(np.uint16)  # counts, as one is taken
    files = tmp_path / "photo.tif", tmp_path / "psf.tif"
    found = db.reconstruct(*files, vignetting=flat, binning=2, dark=0.0, erasures="none", **options)
    assert db.metrics.psnr(found.image / found.image.max(), expected.image / expected.image.max()) > 40
    assert "0.4 to 1" in found.job.notes["Light"]
    with pytest.raises(BenchError, match="give it on the photograph's own pixels"):
        db.reconstruct(*files, vignetting=shade[:20], **options)
    with pytest.raises(BenchError, match="background: for arrays"):
        db.reconstruct(*files, background=1.0)
    with pytest.raises(BenchError, match=r"lines: for arrays .* go into a dark frame: dark=\.$"):
        db.reconstruct(*files, lines=1.0)
    assert "``lines``" in str(db.reconstruct.__doc__)
    assert {"vignetting", "background", "patterns"} <= set(inspect.signature(db.reconstruct).parameters)


def test_a_flat_field_in_counts_is_one_whatever_kind_its_numbers_are(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    photo, psf = plain(scene)
    shade = np.linspace(0.4, 1.0, photo.size).reshape(photo.shape).astype(np.float32)
    counts = np.round(1000 * photo * shade / photo.max()).astype(np.uint16) + 30
    write_image(tmp_path / "photo.tif", counts)
    write_image(tmp_path / "psf.tif", np.round(60_000 * psf / psf.max()).astype(np.uint16))
    files = tmp_path / "photo.tif", tmp_path / "psf.tif"
    options = {"iterations": 3, "judged": False, "model": "convolution", "erasures": "none", "binning": 1}
    expected = db.reconstruct(*files, vignetting=shade, dark=30.0, **options).image
    flat = np.round(20_000 * shade) + 30
    flat[7, 9] = 60_000  # a hot pixel
    for kind in (np.uint16, np.int32, np.float32, np.float64):
        found = db.reconstruct(*files, vignetting=flat.astype(kind), dark=30.0, **options)
        np.testing.assert_allclose(found.image.sum(), expected.sum(), rtol=0.01)
        assert db.metrics.psnr(found.image / expected.max(), expected / expected.max()) > 40, kind
        assert "counts less the dark level given and divided by 1.99" in found.job.notes["Light"]
    found = db.reconstruct(*files, vignetting=flat.astype(np.float32), **options)
    assert "its dark level not taken off (dark= gives it)" in found.job.notes["Light"]
    with pytest.raises(BenchError, match=r"flat field in counts, and .* is a lit, even field"):
        db.reconstruct(*files, vignetting=np.full(photo.shape, 20, np.uint16), dark=30.0, **options)
    with pytest.raises(InputError, match=r"about 1 at most; found .* as of a flat field in counts"):
        db.reconstruct(photo, psf, vignetting=flat)


@pytest.mark.parametrize("name", ["workers", "patterned"])
def test_what_is_of_recordings_is_refused_of_a_photograph(name: str) -> None:
    with pytest.raises(BenchError, match=f"{name}: for a recording, not for a photograph"):
        db.forecast(np.ones((8, 8)), np.eye(8), **{name: 2})


def test_options_are_completed_and_nothing_is_ignored(scene: tuple[np.ndarray, np.ndarray]) -> None:
    named = inspect.signature(db.reconstruct).parameters
    assert {o.name for o in options_of(ReconstructionOptions)} | {"dark", "crop"} <= set(named)
    photo, psf = plain(scene)
    for given, said in (
        ({"z_um": 100.0}, "a bare PSF image has none"),
        ({"dark": 30}, "arrays are taken as they are"),
        ({"iteration": 3}, "Did you mean 'iterations'"),
        ({"bin": 2}, "It is called 'binning'"),
        ({"weight": 0.1}, "Did you mean 'tau'"),
        ({"z_mm": 2}, "It is called 'z_um', in um"),
        ({"prior": db.L1}, r"an object, not its class: L1\(\.\.\.\)"),
        ({"warm": psf}, "a result to start from, not ndarray: warm=result"),
    ):
        with pytest.raises((ValueError, db.BenchError), match=said):
            db.reconstruct(photo, psf, **given)


def test_a_files_image_is_no_array_and_says_where_its_array_is(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    db.write_image(tmp_path / "photo.tif", scene[0])
    photo, psf = db.read(tmp_path / "photo.tif"), plain(scene)[1]
    assert db.Calibration(psf[None, None].astype(float), [[0, 0, 3]]).psfs.dtype == np.float32
    np.testing.assert_array_equal(np.asarray(photo), scene[0])
    for used, said in (
        (lambda: photo.astype(float), "take .pixels.astype"),
        (lambda: photo[:10], ".pixels is its array"),
        (lambda: db.reconstruct(photo, None), "not NoneType"),
        (lambda: db.read(3), "read by its name, not int"),
        (lambda: db.reconstruct(photo, scene[1], scene[0]), r"options are db.Options\(...\), not ndarray"),
        (lambda: db.reconstruct(scene[0][None], scene[1]), "1 of 48 x 48 pixels. Give one of them"),
        (lambda: db.reconstruct(np.dstack([scene[0]] * 3 + [0 * psf + 255]), psf), "fourth channel is 255"),
        (
            lambda: db.reconstruct(np.where(psf > 0, psf, np.inf), psf),
            r"first at \(\d+, \d+\) \(of shape \(48, 48",
        ),
        (lambda: db.hologram(psf[0]), r"A picture is .* not ndarray .* \(48,\)"),
        (lambda: db.calibration(psf), "read by its folder, not ndarray. .* db.Calibration"),
        (lambda: db.Calibration(psf, [[0, 0, 3e3]]), r"not \(48, 48\): psf\[None, None\]"),
        (lambda: db.Calibration(np.full((1, 1, 4, 4), 1e39), [[0, 0, 3]]), "psfs must hold .* not 1e.39"),
        (lambda: db.chart(photo), "ImageFile is neither a result nor a scene .* charted by its result"),
    ):
        with pytest.raises((AttributeError, TypeError, db.BenchError, InputError), match=said):
            used()


def test_how_files_are_read_is_said_by_arrays_and_numbers_as_well(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    for name, image in zip(("photo.tif", "psf.tif"), scene, strict=True):
        db.write_image(tmp_path / name, image)
    files = tmp_path / "photo.tif", tmp_path / "psf.tif"
    assert db.reconstruct(*files, iterations=1, binning="auto").image.shape == (48, 48)
    dark = np.full((48, 48), OFFSET, np.uint16)
    found = db.reconstruct(*files, dark=dark, crop=(0, 0, 40, 44), noise=(2, 0.5), iterations=2)
    assert found.image.shape == (40, 44)
    assert found.facts()["Dark"] == "the frame an array (mean 30.0 counts)"
    for given, said in (
        ({"dark": dark[1:]}, "an array: the dark frame is 47 x 48 .* but the image .*photo.tif is 48 x 48"),
        ({"crop": (0, 0, 40)}, "crop: write TOP,LEFT,HEIGHT,WIDTH"),
        ({"erasures": dark}, r"erasures must be .* not an array of shape \(48, 48\)\."),
    ):
        with pytest.raises((ValueError, db.BenchError), match=said):
            db.reconstruct(*files, **given)


def test_what_a_notebook_shows_is_short() -> None:
    made = make_scene("beads", size=32)
    operator = db.Convolution(made.calibration.psfs[:1, 0], (32, 32))
    outcome = db.Fista(operator, np.ones((1, 32, 32), np.float32), db.L1(1)).run(db.StoppingRules(1))
    for shown, said in (
        (made.calibration, "<Calibration: 8 PSFs 32 x 32 grey, 8 depths, 2.304 to 6.912 mm>"),
        (db.Measurement(made.measurement, noise=2.0), "Measurement(image=<float32 32 x 32>, noise=2.0)"),
        (db.PRIORS, "<priors: tv, tv-isotropic, tv-haar, l1, nonnegative, none"),
        (outcome, "Outcome(solution=<float32 1 x 63 x 64>, history="),
    ):
        assert repr(shown).startswith(said)
        assert len(repr(shown)) < 200


def test_what_a_mask_of_numpys_hides_is_not_used(scene: tuple[np.ndarray, np.ndarray]) -> None:
    photo, psf = plain(scene)
    hidden = np.zeros(photo.shape, bool)
    hidden[3:6, 4] = True
    wrong = np.where(hidden, 10 * photo.max(), photo)
    given = {"iterations": 5, "judged": False}
    found = db.reconstruct(np.ma.masked_array(wrong, hidden), psf, **given)
    assert "3 pixels of the measurement are NaN or masked: they are erased." in found.warnings
    np.testing.assert_array_equal(found.image, db.reconstruct(photo, psf, erasures=hidden, **given).image)
    with pytest.raises(InputError, match="PSF holds 1 values that are not finite"):
        db.reconstruct(photo, np.ma.masked_greater_equal(psf, psf.max()), **given)


def test_what_a_mask_hides_is_not_written_either(tmp_path: Path) -> None:
    hidden = np.ma.masked_equal(np.array([[1, 2], [3, 4000]], np.uint16), 4000)
    write_image(tmp_path / "seen.tif", hidden)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "seen.tif"), [[1, 2], [3, np.nan]])


def test_refusals_name_options_as_python_does(scene: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    write_image(tmp_path / "photo.tif", np.uint16(scene[0]))
    photo = db.read(tmp_path / "photo.tif")
    with pytest.raises(BenchError, match=r"\(diffuserbench snap --dark\), or leave `dark` out"):
        db.reconstruct(photo, scene[1], dark=photo)
    result = db.reconstruct(*plain(scene), iterations=2, stop_at_noise=False)
    result.save(tmp_path / "scene.tif")
    with pytest.raises(BenchError, match="`overwrite=True`"):
        result.save(tmp_path / "scene.tif")
    with pytest.raises(BenchError, match="one by `psf` FILE"):
        db.calibration(tmp_path / "scene.tif")
    with pytest.raises(InputError, match="several depths are a Calibration, or a folder or stack"):
        db.reconstruct(scene[0], np.stack([scene[1]] * 2))
    for asks in (lambda: db.compare("old", "new"), lambda: db.analyse("sweep")):
        with pytest.raises(InputError, match=r"not str: in Python db.calibration\(folder\) reads one"):
            asks()


def test_verdicts_and_warnings_do_too_and_are_written_down_as_typed(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    dim = np.random.default_rng(0).normal(plain(scene)[0] / 1000, 10.0)
    result = db.reconstruct(dim, plain(scene)[1])
    said = (*result.verdict.sentences, *(f.help for f in result.verdict.findings), *result.warnings)
    assert "`model='local'`" in " ".join(said)
    assert not [sentence for sentence in said if "--" in sentence]
    result.save(tmp_path / "scene.tif")
    assert "(--model local)" in (tmp_path / "scene.json").read_text()
    assert db.open_result(tmp_path / "scene.tif").verdict == result.verdict.sentences


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("db.reconstruct(SQUARE)", r"'psf': it is called reconstruct\(image, psf, "),
        ("db.chart(SQUARE, SQUARE)", r"too many .*: it is called chart\(subject, budget_s=..., size="),
        ("db.hologram()", r"'picture': it is called hologram\(picture, bench="),
    ],
)
def test_a_wrong_call_says_how_it_is_called(typed: str, said: str) -> None:
    with pytest.raises(TypeError, match=said):
        eval(typed, _names())


def test_what_is_no_name_is_refused_by_what_saves(scene: tuple[np.ndarray, np.ndarray]) -> None:
    result = db.reconstruct(*plain(scene), iterations=2, judged=False)
    with pytest.raises(InputError, match="out must be the name of a file, not 3"):
        result.save(3)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="figure must be the name of a file, not 3"):
        result.save("scene.tif", figure=3)  # type: ignore[arg-type]


def test_an_operator_is_made_and_turned_round_as_one_tries_first() -> None:
    psf = np.ones((1, 9, 7), np.float32)
    camera = db.Convolution(psf)
    assert camera.range_shape == (1, 9, 7)
    with pytest.raises(AttributeError, match=r"has no T: its adjoint.* is A\.H\."):
        camera.T  # noqa: B018 # type: ignore[attr-defined]


def test_values_are_given_as_python_gives_them() -> None:
    assert in_python("larger pixels (--bin 2) or --model local") == (
        "larger pixels (`binning=2`) or `model='local'`"
    )
    assert (
        in_python("--refine-psf fits it; --no-background")
        == "`refine_psf` fits it; `estimate_background` off"
    )


def test_nan_pixels_are_erased_and_said(scene: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    photo, psf = plain(scene)
    photo[3:6, 4] = np.nan
    erased = np.isnan(photo)
    given = {"iterations": 5, "judged": False}
    found = db.reconstruct(photo, psf, **given)
    assert "3 pixels of the measurement are NaN: they are erased." in found.warnings
    np.testing.assert_array_equal(
        found.image, db.reconstruct(np.where(erased, 0, photo), psf, erasures=erased, **given).image
    )
    for name, image in (("photo.tif", photo), ("psf.tif", psf)):
        db.write_image(tmp_path / name, image)
    assert "3 pixels" in db.reconstruct(tmp_path / "photo.tif", tmp_path / "psf.tif", **given).warnings[0]
    with pytest.raises(db.FileError, match="no finite number"):
        db.reconstruct(tmp_path / "psf.tif", tmp_path / "photo.tif", **given)


def test_a_stack_of_psfs_gives_a_volume_in_colours_of_depth(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    photo, psf = plain(scene)
    np.save(tmp_path / "psfs.npy", np.stack([psf, np.roll(psf, 3, 0)]))
    found = db.reconstruct(photo, tmp_path / "psfs.npy", iterations=3, judged=False)
    assert repr(found).startswith("<Volume 2 x 48 x 48")
    assert found.seen().shape == (48, 48, 3)
    assert db.read(tmp_path / "psfs.npy").is_stack
    np.testing.assert_array_equal(np.asarray(found), found.volume)


def own_prior() -> type[db.Prior]:
    class Ridge(db.Prior):
        """Squares."""

        def __init__(self, weight: float) -> None:
            self.weight = weight

        def value(self, x: np.ndarray) -> float:
            return float(self.weight * np.vdot(x, x) / 2)

        def prox(self, x: np.ndarray, step: float) -> np.ndarray:
            return np.asarray(x / (1 + self.weight * step), x.dtype)

    return Ridge


def test_a_prior_of_ones_own_is_taken_by_every_solver(scene: tuple[np.ndarray, np.ndarray]) -> None:
    given = {"prior": own_prior()(1.0), "iterations": 150, "tolerance": 0.0, "judged": False}
    fista, *others = (
        db.reconstruct(*plain(scene), solver=solver, **given).image
        for solver in ("fista", "admm", "admm-sensor")
    )
    assert max(db.metrics.nrmse(other, fista) for other in others) < 0.02


def test_a_hologram_shows_and_saves_itself(tmp_path: Path) -> None:
    found = db.hologram("portrait", "display", slm=(32, 32), iterations=2)
    assert repr(found).startswith("<Hologram 16 x 16, expansion ")
    assert found.phase_rad.shape == (1, 16, 16)
    assert all(path.exists() for path in found.save(tmp_path / "slm.png"))
    with pytest.warns(UserWarning, match="the middle 20 x 20 of the picture's 20 x 30 pixels"):
        db.hologram(np.ones((20, 30), np.float32), "display", slm=(32, 32), iterations=1)


def test_a_pictures_transparency_is_left_out_of_arrays_as_of_files_and_true_is_light(tmp_path: Path) -> None:
    colour = np.zeros((16, 16, 3), np.uint8)
    colour[4:9, 3:8, 0] = 255
    clear = np.dstack([colour, np.full((16, 16), 255, np.uint8)])
    db.write_image(tmp_path / "colour.png", colour)
    given = {"bench": "display", "slm": (32, 32), "iterations": 1}
    with pytest.warns(UserWarning, match=r"^The picture is in colour"):
        wanted = db.hologram(tmp_path / "colour.png", **given).wanted[0]
    for array, said in (
        (clear, "^the picture, an array: alpha channel left out. The picture is in colour"),
        (colour > 0, "^The picture is in colour"),
    ):
        with pytest.warns(UserWarning, match=said):
            np.testing.assert_array_equal(db.hologram(array, **given).wanted[0], wanted)
    with pytest.warns(UserWarning, match="^the picture, an array: alpha channel left out.$"):
        db.hologram(clear[..., ::3], **given)
    with pytest.raises(
        db.BenchError, match=r"\(height, width, 3\) of real numbers, not ndarray uint8 .*, 5\)"
    ):
        db.hologram(np.dstack([clear, clear[..., 0]]), **given)
    with pytest.raises(db.BenchError, match="fourth channel is 1 everywhere"):
        db.reconstruct(clear > 0, np.ones((16, 16)))


def test_a_chart_of_a_result_is_drawn(
    scene: tuple[np.ndarray, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at_once(problem: Any, setting: Any, _left_s: float, tell: Any) -> Any:
        tell(4.0)  # as often as it looks whether there is a result
        return problem.run(setting, counts=(2,)) if setting.name.startswith("wiener") else "left out"

    monkeypatch.setattr("instrument.evaluation.chart.in_own_process", at_once)
    said = list[str]()
    result = db.reconstruct(*plain(scene), iterations=2, judged=False)
    made = db.chart(result, budget_s=5, on_progress=lambda setting, _left_s: said.append(setting))
    assert len(said) == len(set(said)) > 1, "once before each"
    assert repr(made).startswith("<Chart of Reconstructions, speed against accuracy: an array")
    assert {path.name for path in made.save(tmp_path)} == {
        "chart.json",
        "chart.png",
        "chart.html",
        "chart.csv",
    }


WRONG = {
    "db.photograph('x')": "bench must be a Bench, not 'x'",
    "db.photograph(None)": "bench must be a Bench, not None",
    "db.calibrate_sweep(3, None)": "bench must be a Bench, not 3",
    "db.PointSweep(points_um=[(1, 2), (3, 4)])": "must be a tuple of positions",
    "db.StoppingRules('a')": "iterations must be a whole number, 1 or more, not 'a'",
    "db.StoppingRules(time_s=[1])": r"time_s must be a number, above 0, not \[1\]",
    "db.StoppingRules(time_s=float('inf'))": "time_s must be a finite number, above 0, not inf",
    "db.StoppingRules(tolerance=None)": "tolerance must be a number, 0 or more, not None",
    "db.hologram('head', slm=(16, 16))": "show 18 x 18 details of a picture, and it is judged from 21 x 21",
    "db.hologram('head', slm='16x16')": r"slm must be \(height, width\), two whole numbers, not '16x16'",
    "db.hologram('head', slm=np.array(64))": r"slm must be \(height, width\), two whole numbers, not an ",
    "db.hologram('head', z_mm={0})": "z_mm must be a number, not {0}",
    "db.PointSweep(points_um=[[0, 0, 1e4], [1, 'a', 1e4]])": "must be a tuple of positions",
    "db.write_image('a.tif', SQUARE, metadata=3)": "metadata must be a Mapping, not 3",
    "db.Convolution(SQUARE[None], {9, 8})": r"sensor_shape must be \(height, width\), two whole numbers",
    "db.Convolution(SQUARE[None].astype(str), (9, 9))": "psfs must be an array .* not an array of <U",
    "db.Convolution(1j * SQUARE[None], (9, 9))": "psfs must be an array .* not an array of complex128",
    "db.Fista(CAMERA, SQUARE[None], db.L1(1), step='a')": "step must be a number, above 0, not 'a'",
    "db.Fista(CAMERA, SQUARE[None], db.L1(1), initial=SQUARE[:5])": "initial must be an array of shape",
    "db.Fista(CAMERA, 1j * SQUARE[None], db.L1(1))": "data must be .* not an array of complex128",
    "db.Admm(CAMERA, [[['a']]], db.L1(1))": "data must be what the operator gives, .* not an array of <U1",
    "db.Admm(CAMERA, SQUARE[None], db.L1(1), penalties=3)": "penalties must be a Penalties, not 3",
    "db.Admm(CAMERA, SQUARE[None], db.L1(1), relax='a')": "relax must be a number, above 0, not 'a'",
    "db.hologram('head', slm=(2.5, 4))": "slm must be a whole number, 1 or more, not 2.5",
    "db.hologram('head', 3)": "bench must be the name of a file, not 3. Or one of the simulated ones",
    "db.hologram('head', None, 'lbfgs')": "options must be a HologramOptions, not 'lbfgs'",
    "db.hologram('head', z_mm='near')": "z_mm must be a number, not 'near'",
    "db.hologram('head', z_mm=[0, 30])": "one a picture: there are 1, not 2",
    "db.hologram('head', cancel=True)": "cancel must be an Event, not True",
    "db.hologram('head', on_progress=3)": "on_progress must be a function, not 3",
    "db.hologram('head', alignment=3)": "alignment must be the name of a file, not 3",
    "db.reconstruct(SQUARE, SQUARE, cancel=3)": "cancel must be an Event, not 3",
    "db.reconstruct(SQUARE, SQUARE, cancel=threading.Event)": "cancel must be an object, not its class",
    "db.reconstruct(SQUARE, SQUARE, on_stage='x')": "on_stage must be a function, not 'x'",
    "db.run(3)": "folder must be the name of a folder, not 3",
    "db.open_result(SQUARE)": r"path must be the name of a file, not an array of shape \(9, 9\)",
    "db.bench(3)": "bench must be the name of a file, not 3",
    "db.save_calibration('folder', SQUARE)": "A Calibration is expected, not str",
    "db.write_image(SQUARE, 'a.tif')": "path must be the name of a file, not an array",
    "db.write_image('a.tif', None)": "image must be an array .* of real numbers, or a stack, not NoneType",
    "db.write_image('a.tif', 1j * SQUARE)": "not an array of complex128",
    "db.write_image('a.tif', SQUARE[0])": r"image must be \(height, width\[, channels\]\)",
    "db.show(SQUARE[:0])": r"this is float64 \(0, 9\)",
    "db.show_figure(SQUARE)": "A figure of Matplotlib is shown",
    "db.analyse(CALIBRATION, 'x')": "settings must be an AnalysisSettings, not 'x'",
    "db.chart('beads', budget_s='long')": "budget_s must be a number, above 0, not 'long'",
    "db.chart('beads', size=1.5)": "size must be a whole number, 1 or more, not 1.5",
    "db.chart('beads', folder=3)": "folder must be the name of a folder, not 3",
    "db.Calibration(None, None)": "psfs must hold real numbers",
    "db.Calibration(SQUARE[None, None], [[0, 0, 1e4]], geometry=3)": "geometry must be a Geometry, not int",
    "db.Calibration(SQUARE[None, None], [[0, 0, 1e4]], quality=3)": "quality must be a dict, .* not int",
    "db.Geometry(aperture_mm='x')": r"aperture_mm must be \(height, width\), two numbers, .* not 'x'",
    "db.Geometry(aperture_mm=(1, 'a'))": "aperture_mm must be .* not tuple",
    "db.metrics.psnr(SQUARE.astype(object), SQUARE)": r"object; array.astype\(float\) makes numbers",
    "db.reconstruct(SQUARE, SQUARE.astype(object))": r"object; array.astype\(float\) makes numbers",
    "db.L1(-1)": "A prior's weight must be a number, 0 or more, not -1",
    "db.L1(np.ma.masked)": "A prior's weight must be a number, 0 or more, not masked",
    "db.L1(np.ma.array([0.1], mask=True))": "A prior's weight must be a number, 0 or more, not masked",
    "db.L1([0.1])": "A prior's weight must be a number, 0 or more, not ",
    "db.L1(float('-inf'))": "A prior's weight must be a .*number, 0 or more, not -inf",
    "db.L1(True)": "A prior's weight must be a number, 0 or more, not True",
    "db.Geometry('6.5')": "pixel_pitch_um must be a number, or None where unknown, not str",
    "db.NoiseModel(SQUARE, 1)": "read_noise must be a number, in counts",
    "db.L1('a')": "A prior's weight must be a number, 0 or more, not 'a'",
    "db.TotalVariation(SQUARE)": r"must be a number, 0 or more, not an array of shape \(9, 9\)",
    "db.Box('a', 1)": "The lower limit must be a number, not 'a'",
    "db.Convolution('psf.tif', (9, 9))": "psfs must be an array .* not str",
    "db.Convolution(SQUARE)": r"psfs must be .*, not \(9, 9\). A grey one is psf\[None\]",
    "db.Convolution(SQUARE[None], 9)": r"sensor_shape must be \(height, width\), two whole numbers, not 9",
    "db.Erasures(SQUARE[0, :5], (1, 9, 9))": r"valid must be an array \(height, width\)",
    "db.Fista(SQUARE, SQUARE, db.L1(1))": "operator must be a LinearOperator",
    "db.Fista(CAMERA, SQUARE, db.L1(1))": r"data must be .* an array of shape \(1, 9, 9\)",
    "db.Admm(CAMERA, SQUARE[None], 'tv')": "prior must be a Prior, not 'tv'. db.PRIORS names them",
    "db.metrics.psnr('scene.tif', SQUARE)": "The image must be an array .* of real numbers, not str",
    "db.PRIORS['TV']": "There is no prior 'TV', but tv, ",
    "db.SOLVERS[3]": "There is no solver 3, but admm",
}
"""What may be given to what ``diffuserbench`` offers by mistake, and what is said then."""


def _names() -> dict[str, Any]:
    square = np.ones((9, 9))
    camera = db.Convolution(square[None].astype(np.float32), (9, 9))
    calibration = db.Calibration(square[None, None], [[0, 0, 1e4]])
    modules = {
        "db": db,
        "np": np,
        "threading": threading,
        "multiprocessing": multiprocessing,
        "Decimal": Decimal,
    }
    modules |= {"require_hooks": require_hooks, "depths_of": _depths}
    return modules | {"SQUARE": square, "CAMERA": camera, "CALIBRATION": calibration}


@pytest.mark.parametrize("typed", WRONG)
def test_what_is_no_argument_is_said_in_a_sentence(typed: str) -> None:
    with pytest.raises((InputError, BenchError), match=WRONG[typed]) as found:
        eval(typed, _names())
    said = str(found.value)
    assert said[-1] == "."
    assert "\n" not in said


TAKEN = (
    "db.open_result(IMAGE)",
    "db.bench(BENCH)",
    "db.write_image(IMAGE, SQUARE)",
    "db.write_image('line.npy', SQUARE[0])",
    "db.write_image('number.npy', np.array(2.0))",
    "require_hooks(None, multiprocessing.Event())",
    "db.Geometry(np.array(6.5))",
    "db.Geometry(aperture_mm=[5.5, np.array(7)])",
    "db.Geometry(aperture_mm=np.array([5.5, 7]))",
    "db.Box(np.array(0.0), float('inf'))",
    "db.L1(np.array([[0.1]]))",
    "db.L1(Decimal('0.1'))",
    "db.L1(float('inf'))",
    "db.Box(np.array([0.0]), np.array([[1.0]]))",
    "db.Geometry(np.array([[6.5]]), Decimal('2.1'), np.array([[3.0], [4.0]]))",
    "depths_of(np.array(0.0), 2)",
    "db.PointSweep(points_um=[[0, 0, 1e4], [1, 0, 1e4]])",
    "db.PointSweep(points_um=np.array([[0, 0, 1e4], [1, 0, 1e4]]))",
    "db.NoiseModel(np.array(2.0), np.array(0.1))",
    "db.StoppingRules(tolerance=np.array(1e-3), time_s=np.array(2))",
    "db.Convolution(SQUARE[None], (9.0, np.array(9)))",
    "db.Fista(CAMERA, SQUARE[None].tolist(), db.L1(np.array(1.0)))",
    "db.Admm(CAMERA, SQUARE[None].tolist(), db.L1(1))",
)
"""What is of another type than the one documented, and as good."""


@pytest.fixture(scope="module")
def taken_names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("taken")
    write_image(folder / "image.tif", np.ones((9, 9), np.float32))
    (folder / "bench.toml").write_text(template("default"))
    entries = {entry.name: entry for entry in os.scandir(folder)}
    return {"IMAGE": entries["image.tif"], "BENCH": entries["bench.toml"]}


@pytest.mark.parametrize("typed", TAKEN)
def test_what_is_as_good_as_what_is_documented_is_taken(
    typed: str, taken_names: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    eval(typed, _names() | taken_names)


def test_names_that_are_not_registered_are_missing_as_in_any_mapping() -> None:
    assert db.SOLVERS.get("none of these") is None
    assert "none of these" not in db.PRIORS
    with pytest.raises(KeyError):
        db.CAMERAS["none of these"]
    with pytest.raises(TypeError, match="unsupported operand"):
        db.L1(1.0) + 3
