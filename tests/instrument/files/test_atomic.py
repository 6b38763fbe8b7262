"""What a killed program left of files and folders it was writing, and names that are never missing."""

from __future__ import annotations

import errno
import os
import shutil
import signal
from pathlib import Path

import pytest

from instrument.files import atomic
from instrument.files.atomic import whole_file, whole_folder, write_text


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

    open_files = len(list(Path("/proc/self/fd").iterdir()))
    write("old")
    assert len(list(Path("/proc/self/fd").iterdir())) == open_files
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
    for free, why, number in ((0, "half", errno.ENOSPC), (10**9, "half", None), (0, errno.EIO, errno.EIO)):
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
