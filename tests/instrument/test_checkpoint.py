"""Reconstructions that are kept in a folder and gone on with."""

import json
import resource
import shutil

import numpy as np
import pytest
import tifffile

from instrument.cli import main
from instrument.files.errors import FileError
from instrument.reconstruction.checkpointing import CheckpointFolder, digest
from recon.camera.convolution import Convolution
from recon.priors import NonNegativity, TotalVariation
from recon.solvers import Fista, SensorAdmm, StoppingRules
from recon.solvers.volume_admm import VolumeAdmm

SIZE = 24


@pytest.fixture
def files(tmp_path):
    rng = np.random.default_rng(0)
    psf = np.where(rng.random((2, SIZE, SIZE)) > 0.97, 900, 0).astype(np.uint16)
    scene = 3 * np.roll(psf[0], (3, -2), (0, 1)) + rng.integers(0, 20, (SIZE, SIZE))
    for name, image in (("psf", psf[0]), ("psfs", psf), ("image", scene), ("other", scene[::-1])):
        tifffile.imwrite(tmp_path / f"{name}.tif", image.astype(np.uint16))
    return tmp_path


@pytest.fixture
def run(files, capsys):
    def call(*arguments, image="image.tif"):
        code = main(
            [
                "reconstruct",
                "-i",
                str(files / image),
                "--dark",
                "0",
                "--tolerance",
                "0",
                "--force",
                *map(str, arguments),
            ]
        )
        output = capsys.readouterr()
        return code, " ".join((output.out + output.err).split())

    return call


@pytest.mark.parametrize(
    "what",
    [
        ("--psf", "psf.tif"),
        ("--psf", "psf.tif", "--method", "fista"),
        # The model is named: what --model auto chooses besides it, it does not choose with --checkpoint.
        ("--volume", "psfs.tif", "--prior", "l1", "--model", "convolution"),
    ],
    ids=["picture", "fista", "volume"],
)
def test_the_same_command_goes_on_to_the_same_end(files, run, what):
    what = (what[0], files / what[1], *what[2:])
    kept, out, whole = files / "kept", files / "a.tif", files / "b.tif"
    code, said = run(*what, "-n", 8, "--checkpoint", kept, "-o", out)
    assert code == 0, said
    assert "goes on from it" in said
    code, said = run(*what, "-n", 20, "--checkpoint", kept, "-o", out)
    assert "from iteration 8" in said
    run(*what, "-n", 20, "-o", whole)
    # To rounding: sums of float32 depend on where in memory arrays happen to lie.
    expected = tifffile.imread(whole)
    assert tifffile.imread(out) == pytest.approx(expected, abs=1e-5 * float(expected.max()))
    assert json.loads(out.with_suffix(".json").read_text())["stop_reason" if what[0] == "--psf" else "model"]


def test_a_folder_kept_for_something_else_is_refused(files, run):
    kept = files / "kept"
    arguments = ("--psf", files / "psf.tif", "-n", 5, "--checkpoint", kept, "-o", files / "a.tif")
    assert run(*arguments)[0] == 0
    code, said = run(*arguments, image="other.tif")
    assert code == 2
    assert "keeps another reconstruction: its measurement is" in said
    code, said = run(*arguments, "--tau", 0.1)
    assert code == 2
    assert "its tau is None, here it is 0.1" in said
    code, said = run(*arguments, "--noise", 4)
    assert code == 2
    assert "its noise is 'None', here it is '4.0'" in said
    code, said = run(*arguments[:-4], "--checkpoint", files, "-o", files / "a.tif")
    assert code == 2
    assert "holds something else" in said


def test_it_is_removed_where_nothing_is_left_to_do(files, run):
    kept = files / "kept"
    code, said = run(
        "--psf",
        files / "psf.tif",
        "--noise",
        1e5,
        "--stop-at-noise",
        "--checkpoint",
        kept,
        "-o",
        files / "a.tif",
    )
    assert code == 0, said
    assert "removed: the work has come to its end" in said
    assert not kept.exists()


def solver(kind=SensorAdmm):
    rng = np.random.default_rng(1)
    camera = Convolution(rng.random((1, 5, 6)), (8, 9))
    return kind(camera, rng.random((1, 8, 9)).astype(np.float32), TotalVariation(0.1) + NonNegativity())


def test_what_is_kept_before_a_kill_is_whole(tmp_path):
    keeper = CheckpointFolder(tmp_path / "kept", {"a": 1}, every_s=0.0)
    seen = []

    def watch(running, record):
        if record.iteration == 4:
            seen.append(running.solution.copy())
        if record.iteration == 5:
            raise KeyboardInterrupt  # as the second Ctrl-C, or worse

    with pytest.raises(KeyboardInterrupt):
        solver().run(StoppingRules(tolerance=0), keeper=keeper, callback=watch)
    again = solver()
    records = CheckpointFolder(tmp_path / "kept", {"a": 1}).resume("", again)
    assert [r.iteration for r in records] == [1, 2, 3, 4]
    assert np.array_equal(again.solution, seen[0])


def test_a_damaged_file_is_named(tmp_path):
    keeper = CheckpointFolder(tmp_path / "kept", {})
    solver().run(StoppingRules(iterations=2), keeper=keeper)
    (tmp_path / "kept" / "picture.npz").write_bytes(b"PK nothing")
    with pytest.raises(FileError, match=r"picture\.npz.*cannot be read as a checkpoint"):
        keeper.resume("", solver())
    solver(Fista).run(StoppingRules(iterations=2), keeper=CheckpointFolder(tmp_path / "other", {}))
    with pytest.raises(FileError, match="kept by another version of the program, or of another solver"):
        CheckpointFolder(tmp_path / "other", {}).resume("", solver())


def volume_solver():
    rng = np.random.default_rng(2)
    camera = Convolution(rng.random((2, 1, 5, 6)), (8, 9))
    prior = TotalVariation.of_volume(0.1) + NonNegativity()
    return VolumeAdmm(camera, rng.random((1, 8, 9)).astype(np.float32), prior)


def test_what_priors_that_were_split_off_keep_is_gone_on_with(tmp_path):
    keeper = CheckpointFolder(tmp_path / "kept", {})
    rules = StoppingRules(iterations=12, tolerance=0)
    whole = volume_solver().run(rules)
    volume_solver().run(StoppingRules(iterations=5, tolerance=0), keeper=keeper)
    assert np.array_equal(volume_solver().run(rules, keeper=keeper).solution, whole.solution)


OLD_PROBLEM = {
    "kind": "picture", "measurement": "1 x 24 x 24 float32, 0123456789abcdef", "method": "admm",
    "program": "diffuserbench 0.1.0", "tau": None,
}  # fmt: skip
"""Some of what commit 813d646 wrote."""


def test_a_folder_of_an_older_version_is_refused_in_one_sentence(files, run):
    kept = files / "kept"
    kept.mkdir()
    (kept / "problem.json").write_text(json.dumps(OLD_PROBLEM))
    np.savez(kept / "picture.npz", **{"history": np.ones((1, 8)), "state/_tx": np.zeros((1, 4, 4))})
    before = {path.name: path.read_bytes() for path in kept.iterdir()}
    code, said = run("--psf", files / "psf.tif", "-n", 5, "--checkpoint", kept, "-o", files / "a.tif")
    assert code == 2
    assert "was kept by another version of the program, which this one cannot go on from." in said
    assert "Traceback" not in said
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == before


@pytest.mark.parametrize("lacking", ["iteration", "_mu", "_splits.tx"])
def test_a_state_that_lacks_something_is_refused(tmp_path, lacking):
    keeper = CheckpointFolder(tmp_path / "kept", {})
    solver().run(StoppingRules(iterations=2), keeper=keeper)
    path = tmp_path / "kept" / "picture.npz"
    with np.load(path) as kept:
        state = {name: kept[name] for name in kept.files if name != f"state/{lacking}"}
    np.savez(path, **state)
    with pytest.raises(FileError, match=rf"another version of the program.* has no '{lacking}'"):
        keeper.resume("", solver())


def test_a_digest_tells_arrays_apart():
    a = np.arange(6.0).reshape(2, 3)
    assert digest(a) == digest(a.copy())
    assert len({digest(a), digest(a.T), digest(a + 1), digest(a.astype(np.float32)), digest(None)}) == 5


def test_a_checkpoint_outlives_a_result_that_cannot_be_written(files, run, monkeypatch):
    import instrument.tasks.solving as module

    def full(*_args, **_kwargs):
        raise FileError(files / "a.tif", "cannot be written: the disk is full.", "Make room.")

    kept = files / "kept"
    what = ("--psf", files / "psf.tif", "--tolerance", "0.5", "--checkpoint", kept, "-o", files / "a.tif")
    with monkeypatch.context() as broken:
        broken.setattr(module, "write_reconstruction", full)
        code, said = run(*what)
    assert code == 2
    assert "disk is full" in said
    assert list(kept.iterdir())
    code, said = run(*what)
    assert code == 0, said
    assert "removed: the work has come to its end" in said


def test_results_do_not_go_into_the_folder_that_is_removed(files, run):
    kept = files / "kept"
    what = ("--psf", files / "psf.tif", "--tolerance", 0.5, "--checkpoint", kept)
    kept.mkdir()
    for outputs in (("-o", kept / "r.tif"), ("-o", files / "a.tif", "--figure", kept / "f.pdf")):
        code, said = run(*what, *outputs)
        assert code == 2
        assert f"lies in the checkpoint {kept}, which is removed in the end." in said
    assert not list(kept.iterdir())
    (inside := files / "v.ome.zarr" / "kept").mkdir(parents=True)
    code, said = run(
        "--volume", files / "psfs.tif", "--prior", "l1", "--checkpoint", inside, "-o", inside.parent
    )
    assert code == 2
    assert f"lies in {inside.parent}, which is replaced" in said


def test_a_checkpoint_that_somebody_has_deleted_is_removed(tmp_path):
    keeper = CheckpointFolder(tmp_path / "kept", {})
    (tmp_path / "kept" / "problem.json").unlink()
    (tmp_path / "kept").rmdir()
    assert keeper.remove() == ()


@pytest.mark.parametrize("lost", ["deleted", "moved", "full"])
def test_a_checkpoint_that_cannot_be_kept_on_costs_no_result(files, run, monkeypatch, lost):
    """What the folder's loss would take is the picture itself; that it is lost is said once."""
    kept, out, whole = files / "kept", files / "a.tif", files / "b.tif"
    keep, calls = CheckpointFolder.keep, []
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def keeping(*given, **named):
        calls.append(given)
        if len(calls) == 3 and lost == "deleted":
            shutil.rmtree(kept)
        elif len(calls) == 3 and lost == "moved":
            kept.rename(files / "elsewhere")
        if len(calls) >= 3 and lost == "full":
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        try:
            keep(*given, **named)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    what = ("--psf", files / "psf.tif", "-n", 8)
    assert run(*what, "-o", whole)[0] == 0
    monkeypatch.setattr(CheckpointFolder, "keep", keeping)
    monkeypatch.setitem(CheckpointFolder.__init__.__kwdefaults__, "every_s", 0.0)
    code, said = run(*what, "--checkpoint", kept, "-o", out)
    assert code == 0, said
    assert len(calls) > 3
    assert said.count("The work goes on; ") == 1
    reason = "file too large" if lost == "full" else "was deleted or moved meanwhile"
    assert said.lower().count(reason) == 2, "at once, and in the end"
    assert "goes on from it" not in said
    assert said.count("what it has done is not kept for another time.") == (lost != "full")
    assert said.count("the same again goes on from there.") == 2 * (lost == "full"), "at once, and in the end"
    expected = tifffile.imread(whole)
    assert tifffile.imread(out) == pytest.approx(expected, abs=1e-5 * float(expected.max()))
    assert kept.exists() == (lost == "full")
    if lost == "full":
        monkeypatch.setattr(CheckpointFolder, "keep", keep)
        code, said = run(*what, "--checkpoint", kept, "-o", out)
        assert code == 0, said
        assert "from iteration 2" in said


def test_the_time_that_writing_takes_does_not_count_to_the_next(tmp_path, monkeypatch):
    """Where a disk is slow every iteration was written."""
    clock, written = [0.0], []
    savez = np.savez

    def slow(*given, **named):
        written.append(given)
        clock[0] += 100.0
        savez(*given, **named)

    monkeypatch.setattr("instrument.reconstruction.checkpointing.time.monotonic", lambda: clock[0])
    monkeypatch.setattr(np, "savez", slow)
    keeper = CheckpointFolder(tmp_path / "kept", {}, every_s=60.0)
    running = solver()
    records = running.run(StoppingRules(iterations=2)).history
    clock[0] += 61.0
    for _ in range(3):
        clock[0] += 1.0
        keeper.keep("", running, records, ended=False)
    assert len(written) == 1


def test_only_what_was_kept_is_removed(files, run):
    """An empty folder is taken; what others put into it since stays, and it with that."""
    kept = files / "kept"
    kept.mkdir()
    what = ("--psf", files / "psf.tif", "--checkpoint", kept, "-o", files / "a.tif")
    code, said = run(*what, "-n", 2)
    assert code == 0, said
    np.savez(kept / "mine.npz", psf=np.zeros(3))
    (kept / "notes.txt").write_text("mine")
    (kept / ".picture.01234567.part.npz").write_bytes(b"of a killed program")
    code, said = run(*what, "--tolerance", 0.5)
    assert code == 0, said
    assert (
        f"removed: the work has come to its end; {kept} stays, for what else it holds: mine.npz, notes"
        in said
    )
    assert sorted(path.name for path in kept.iterdir()) == ["mine.npz", "notes.txt"]
