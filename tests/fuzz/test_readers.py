"""Damaged, hostile and special files end in one sentence, soon, without much memory."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from instrument.bench.config_file import load_config
from instrument.files.errors import BenchError
from instrument.files.images import read_image, write_image
from instrument.files.volumes import open_volume
from instrument.plan.model import load_plan
from instrument.reconstruction.stored_result import open_result
from tests.fuzz.__main__ import CORPUS, fuzz
from tests.fuzz.readers import READERS


@pytest.mark.parametrize("name", READERS)
def test_a_short_fuzz_and_all_that_broke_a_reader_before(name: str) -> None:
    kept = len(list((CORPUS / name).glob("*")))
    count, found = fuzz(name, seconds=30, runs=kept + 12, seed=2, keep=False)
    assert count
    assert not found, found


@pytest.mark.parametrize("read", [load_config, load_plan, read_image, open_volume, open_result])
@pytest.mark.parametrize("suffix", [".toml", ".json", ".tif", ".npy", ".png"])
def test_a_pipe_and_an_endless_device_are_refused_at_once(tmp_path: Path, read: object, suffix: str) -> None:
    pipe, endless = tmp_path / f"pipe{suffix}", tmp_path / f"zero{suffix}"
    os.mkfifo(pipe)
    endless.symlink_to("/dev/zero")
    for path in (pipe, endless):
        with pytest.raises(BenchError):
            read(path)  # type: ignore[operator]


def test_what_claims_more_than_it_holds_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    claims = tmp_path / "a.npy"
    with claims.open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
        )
    with pytest.raises(BenchError, match="more bytes than it has"):
        read_image(claims)
    with (sparse := tmp_path / "nothing.tif").open("wb") as file:
        file.truncate(20 << 30)
    with pytest.raises(BenchError, match="no image that can be read"):
        read_image(sparse)
    bomb = tmp_path / "bomb.npz"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        for _ in range(600):
            member.write(bytes(1 << 20))
    with pytest.raises(BenchError, match="made to fill the memory"):
        read_image(bomb)
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("a.txt", "no array")
    with pytest.raises(BenchError, match="no plain"):
        read_image(tmp_path / "text.npz")
    write_image(tmp_path / "a.png", np.zeros((4, 4), np.uint8))
    png = bytearray((tmp_path / "a.png").read_bytes())
    png[16:24] = (60000).to_bytes(4, "big") * 2
    (tmp_path / "a.png").write_bytes(png)
    with pytest.raises(BenchError, match="made to fill the memory"):
        read_image(tmp_path / "a.png")
