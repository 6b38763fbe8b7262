"""What a killed program left of files and folders it was writing, and names that are never missing."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from instrument.files import atomic
from instrument.files.atomic import whole_file, whole_folder, write_text
from instrument.files.errors import FileError


def open_below(folder: Path) -> list[str]:
    """Return what of a folder this process has open: other tests may leave files of theirs."""
    found = []
    for handle in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # closed since it was listed
            found.append(str(handle.readlink()))
    return [name for name in found if name.startswith(str(folder))]


def killed_while_it_writes(path: Path) -> None:
    """Write a file and a folder in another process, which is killed within."""
    process = os.fork()
    if process == 0:
        with whole_file(path) as file, whole_folder(path.with_suffix("")) as folder:
            file.write_text("half")
            (folder / "a").write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(process, 0)


def test_what_a_killed_program_left_goes_and_what_is_being_written_stays(tmp_path: Path) -> None:
    write_text(tmp_path / ".mine.0123abcd.txt", "a hidden file of the user's")
    killed_while_it_writes(tmp_path / "kept.txt")
    assert len(list(tmp_path.iterdir())) == 3
    with whole_file(tmp_path / "slow.txt") as slow, whole_folder(tmp_path / "slow") as folder:
        slow.write_text("so far")
        atomic._cleared.clear()  # as another program begins
        write_text(tmp_path / "kept.txt", "whole")
        assert slow.exists()
        assert folder.exists()
        assert len(list(tmp_path.iterdir())) == 4
    assert {p.name for p in tmp_path.iterdir()} == {".mine.0123abcd.txt", "kept.txt", "slow.txt", "slow"}


def test_a_folder_that_is_replaced_is_never_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(text: str) -> None:
        with whole_folder(tmp_path / "c") as draft:
            write_text(draft / "a", text)

    write("old")
    assert not open_below(tmp_path)
    assert not (tmp_path / "c" / "a").stat().st_mode & 0o111
    (tmp_path / "d").mkdir()
    if not atomic._exchanged(tmp_path / "c", tmp_path / "d"):
        pytest.skip("this system or disk cannot exchange two names")
    atomic._exchanged(tmp_path / "c", tmp_path / "d")
    monkeypatch.setattr(Path, "rename", lambda *_: pytest.fail("renamed in two steps"))
    write("new")
    assert (tmp_path / "c" / "a").read_text() == "new"
    assert {p.name for p in tmp_path.iterdir()} == {"c", "d"}


def test_a_writer_that_notices_too_little_written_is_told_of_the_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, nearly = (0, "half", errno.ENOSPC), ((1 << 20) - 1, "half", errno.ENOSPC)
    for free, why, number in (full, nearly, (1 << 20, "half", None), (0, errno.EIO, errno.EIO)):
        usage = shutil.disk_usage(tmp_path)._replace(free=free)
        monkeypatch.setattr(shutil, "disk_usage", lambda _, usage=usage: usage)
        with pytest.raises(OSError, match="tif") as caught, whole_file(tmp_path / "a.tif"):
            raise OSError(why, "said") if isinstance(why, int) else OSError(why)
        assert caught.value.errno == number
        assert caught.value.filename == str(tmp_path / "a.tif")
        assert not list(tmp_path.iterdir())


def test_a_name_that_cannot_be_made_closes_nothing_of_others(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="too long"), whole_file(tmp_path / ("a" * 250)):
        raise AssertionError("never begun")
    os.fstat(1)


def test_two_names_are_exchanged_exactly_where_it_says_so(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    one.write_text("1")
    other.write_text("2")
    assert atomic._exchanged(one, other) == (one.read_text() == "2")
    assert not atomic._exchanged(one, tmp_path / "none")


def test_json_is_indented_by_one_so_that_its_lines_are_short() -> None:
    assert atomic.json_text({"a": {"b": 1}}).strip() == '{\n "a": {\n  "b": 1\n }\n}'
    assert atomic.json_text({"a": "µm"}) == '{\n "a": "µm"\n}\n'
    with pytest.raises(ValueError, match="not JSON compliant"):
        atomic.json_text({"a": float("nan")})


@pytest.fixture
def said_to_the_disk(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Note what is synced, by name, and what is renamed, by its new name."""
    done: list[tuple[str, str]] = []

    def noted(what: str, action: Callable[..., Any]) -> Callable[..., Any]:
        def do(*arguments: Any) -> Any:
            at = arguments[-1] if what == "renamed" else f"/proc/self/fd/{arguments[0]}"
            done.append((what, Path(at).resolve().name))
            return action(*arguments)

        return do

    monkeypatch.setattr(os, "fsync", noted("synced", os.fsync))
    for name in ("replace", "rename"):
        monkeypatch.setattr(Path, name, noted("renamed", getattr(Path, name)))
    return done


def test_what_is_in_a_file_or_folder_is_on_the_disk_before_its_name_is(
    tmp_path: Path, said_to_the_disk: list[tuple[str, str]]
) -> None:
    with whole_file(tmp_path / "a.txt") as draft:
        draft.write_text("a")
    assert said_to_the_disk == [("synced", draft.name), ("renamed", "a.txt"), ("synced", tmp_path.name)]
    said_to_the_disk.clear()
    with whole_folder(tmp_path / "b") as draft:
        (draft / "in").mkdir()
        (draft / "in" / "x").write_text("x")
    assert set(said_to_the_disk[:3]) == {("synced", name) for name in (draft.name, "in", "x")}
    assert said_to_the_disk[3:] == [("renamed", "b"), ("synced", tmp_path.name)]
    said_to_the_disk.clear()
    atomic.make_folder(tmp_path / "c")
    assert said_to_the_disk == [("synced", tmp_path.name)]
    assert (tmp_path / "c").is_dir()


def test_where_names_cannot_be_exchanged_a_folder_is_put_back_when_the_new_one_cannot_be_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OldSystem:
        def __init__(self, _: object) -> None: ...

    monkeypatch.setattr(ctypes, "CDLL", OldSystem)
    assert not atomic._exchanged(tmp_path, tmp_path)
    for text in ("old", "new"):
        with whole_folder(tmp_path / "c") as draft:
            (draft / "a").write_text(text)
    assert (tmp_path / "c" / "a").read_text() == "new"
    assert os.listdir(tmp_path) == ["c"]  # noqa: PTH208

    rename = Path.rename
    monkeypatch.setattr(Path, "rename", lambda p, to: missing() if p == draft else rename(p, to))

    def missing() -> None:
        raise OSError(errno.EIO, "said")

    for name in ("c", "d"):
        with pytest.raises(OSError, match="said"), whole_folder(tmp_path / name) as draft:
            (draft / "a").write_text("newest")
    assert (tmp_path / "c" / "a").read_text() == "new"
    assert os.listdir(tmp_path) == ["c"]  # noqa: PTH208


def test_a_folder_is_cleared_once_a_program_and_again_when_asked(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / ".link.0123abcd.part").symlink_to(tmp_path / "mine")
    left = tmp_path / ".a.89abcdef.part.txt"
    for again, goes in ((False, True), (False, False), (True, True)):
        left.write_text("half")
        atomic.clear_left(tmp_path, again=again)
        assert left.exists() != goes
    assert (tmp_path / ".link.0123abcd.part").is_symlink()
    assert not open_below(tmp_path)


def test_inputs_are_inputs_while_the_work_lasts(tmp_path: Path) -> None:
    for name in ("photograph", "mask", "link", "hard"):
        (tmp_path / name).write_text(name)
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("photograph")
    (tmp_path / "hard").unlink()
    (tmp_path / "hard").hardlink_to(tmp_path / "mask")
    for folder, own in (("images", "a.png"), ("run", "state.json"), ("calibration", "calibration.json")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / own).write_text("own")
        (tmp_path / folder / "b.png").write_text("b")

    def refused() -> dict[str, str]:
        found = {}
        names = ("photograph", "link", "mask", "hard", ".", "images", "images/b.png", "images/new", "run")
        for name in (*names, "run/b.png", "calibration/b.png", "new", "other"):
            try:
                atomic.refuse_input(tmp_path / name)
            except FileError as error:
                found[name] = error.problem.partition(";")[0]
        return found

    (tmp_path / "other").write_text("other")
    atomic.protect(tmp_path / "photograph")  # nobody's work
    assert refused() == {}
    itself = "is an input itself"
    with atomic.protecting([tmp_path / "photograph", tmp_path / "new"]):
        atomic.protect(tmp_path / "mask")
        first = {**dict.fromkeys(("photograph", "link", "mask", "hard"), itself)}
        assert refused() == first | {".": f"holds the input {tmp_path / 'photograph'}"}
        with atomic.protecting([tmp_path / name for name in ("images", "run", "calibration")]):
            assert refused() == first | {
                ".": f"holds the input {tmp_path / 'photograph'}",
                "images": itself,
                "images/b.png": f"is part of the input {tmp_path / 'images'}",
                "run": itself,
            }
            for write in (
                lambda path: write_text(path, "x"),
                atomic.check_writable,
                lambda path: atomic.require_new(path, overwrite=True),
                lambda path: whole_folder(path).__enter__(),
            ):
                with pytest.raises(FileError, match="no output replaces an input"):
                    write(tmp_path / "run")
        assert "run" not in refused()
    assert refused() == {}


def test_what_a_folder_that_is_read_has_by_links_is_an_input(tmp_path: Path) -> None:
    for folder in ("psfs", "raw", "more", "far"):
        (tmp_path / folder).mkdir()
    for name in ("raw/a.tif", "raw/other.tif", "far/b.tif"):
        (tmp_path / name).write_text("measured")
    links = ("psfs/a.tif", "raw/a.tif"), ("psfs/more", "more"), ("more/far", "far"), ("more/back", "psfs")
    for link, target in links:
        (tmp_path / link).symlink_to(tmp_path / target)
    (tmp_path / "psfs" / "gone.tif").symlink_to(tmp_path / "gone.tif")
    (tmp_path / "psfs" / "itself").symlink_to(tmp_path / "psfs" / "itself")
    refused = ("raw/a.tif", "psfs/a.tif", "raw", "more", "far", "far/b.tif", "psfs/more/far/b.tif")
    with atomic.protecting([tmp_path / "psfs"]):
        for name in refused:
            with pytest.raises(FileError, match="no output replaces an input"):
                atomic.refuse_input(tmp_path / name)
        for name in ("raw/other.tif", "raw/new.tif", "gone.tif"):
            atomic.refuse_input(tmp_path / name)


def test_a_doubted_result_has_a_doubtful_name_of_its_own(tmp_path: Path) -> None:
    path, doubtful = tmp_path / "a.png", tmp_path / "doubtful_a.png"
    assert atomic.named_by_worth(path, doubted=False) == path
    assert atomic.named_by_worth(path, doubted=True, overwrite=False) == doubtful
    for taken, then in ((doubtful, "doubtful_a-2.png"), (tmp_path / "doubtful_a-2.png", "doubtful_a-3.png")):
        taken.write_text("before")
        assert atomic.named_by_worth(path, doubted=True, overwrite=False) == tmp_path / then
        assert atomic.named_by_worth(path, doubted=True) == doubtful


def test_what_is_there_is_left_unless_it_may_be_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a"
    atomic.require_new(path)
    path.write_text("before")
    atomic.require_new(path, overwrite=True)
    for allowed, remedy in ((None, ""), (False, "Choose another name, or overwrite with --force.")):
        with pytest.raises(FileError, match="exists already and was left as it is") as caught:
            atomic.require_new(path, overwrite=allowed)
        assert caught.value.remedy == remedy
    with pytest.raises(FileError, match="is a file; a folder is expected"):
        atomic.output_folder(path)
    for _ in range(2):
        atomic.output_folder(tmp_path / "b" / "c")
    atomic.write_json(tmp_path / "b" / "c" / "d.json", {})
    assert (tmp_path / "b" / "c" / "d.json").read_text() == "{}\n"


@pytest.mark.parametrize(
    ("name", "disk", "allowed", "problem"),
    [
        ("a", {}, True, ""),
        ("file", {}, True, ""),
        ("a", {"f_bavail": 9}, True, "needs 0.0 MB, and 0.0 MB are free"),
        (".", {}, True, "is a folder; a file name is expected."),
        ("pipe", {}, True, "is a device or pipe, which a file would take the place of."),
        ("none/a", {}, True, "its folder .* does not exist."),
        ("file/a", {}, True, "its folder .* is no folder."),
        ("a", {}, False, "no permission to write in"),
        ("a", {"f_flag": os.ST_RDONLY | os.ST_NOSUID}, False, "is on a read-only disk."),  # nobody may
        ("a", {"f_blocks": 0}, True, ""),  # a FUSE disk that does not say its size
        ("/proc/self/a", {"f_blocks": 0}, True, "is the system's own and holds no files of ours."),
        ("/proc/self/a", {"f_blocks": 1}, True, ""),
    ],
)
def test_a_file_that_could_not_be_written_is_refused_before_the_work(
    name: str, disk: dict[str, int], allowed: bool, problem: str, tmp_path: Path, monkeypatch: Any
) -> None:
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    sizes = {"f_flag": os.ST_NOSUID, "f_blocks": 1, "f_bavail": 10, "f_frsize": 100} | disk
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(**sizes))
    monkeypatch.setattr(os, "access", lambda _, mode: allowed and mode == os.W_OK | os.X_OK)
    if problem:
        with pytest.raises(FileError, match=problem):
            atomic.check_writable(tmp_path / name, 1000)
    else:
        atomic.check_writable(tmp_path / name, 1000)


def test_of_an_array_of_a_file_the_file_is_held(tmp_path: Path) -> None:
    (tmp_path / "all.npz").touch()
    (tmp_path / "named::so.npy").touch()
    with atomic.protecting([Path(f"{tmp_path}/all.npz::psfs"), tmp_path / "named::so.npy"]):
        for name in ("all.npz", "named::so.npy"):
            with pytest.raises(FileError, match="is an input itself"):
                atomic.refuse_input(tmp_path / name)
