"""Our reader of MATLAB files, held against scipy's and against MATLAB's own files."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from instrument.files.errors import FileError
from instrument.files.images import read_stack
from instrument.files.matlab import arrays_in, read_array

RNG = np.random.default_rng(1)
KINDS = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")


@pytest.mark.parametrize("compressed", [False, True])
def test_numbers_of_every_kind_are_those_that_scipy_reads(tmp_path: Path, *, compressed: bool) -> None:
    path = tmp_path / "a.mat"
    arrays: dict[str, Any] = {f"of_{kind}": (100 * RNG.random((3, 5, 2))).astype(kind) for kind in KINDS}
    arrays |= {
        "a": np.arange(3.0),
        "b": 5.0,
        "wave": RNG.random((4, 3)) + 1j,
        "mask": RNG.random((4, 3)) > 0.5,
    }
    arrays |= {"empty": np.zeros((0, 3)), "a_name_of_many_letters": np.eye(2)}
    beside = {"text": "not a number", "cells": np.array([[1, "a"]], object), "parts": {"x": 1.0}}
    scipy.io.savemat(path, arrays | beside, do_compression=compressed)
    found = arrays_in(path)
    assert sorted(found) == sorted(arrays)
    theirs = scipy.io.loadmat(path)
    for name, array in found.items():
        mine = read_array(path, array)
        assert array.shape == theirs[name].shape
        assert mine.dtype.isnative
        assert mine.dtype == theirs[name].dtype or theirs[name].dtype == bool
        np.testing.assert_array_equal(mine, theirs[name])


def _of_matlab() -> list[Any]:
    folder = files("scipy.io.matlab") / "tests" / "data"
    return (
        sorted(str(path) for path in folder.iterdir() if path.name.endswith(".mat"))
        if folder.is_dir()
        else []
    )


@pytest.mark.skipif(not _of_matlab(), reason="scipy was installed without its tests' files")
def test_files_that_matlab_wrote_are_read_as_scipy_reads_them() -> None:
    seen = 0
    for path in map(Path, _of_matlab()):
        if not path.read_bytes().startswith(b"MATLAB 5.0"):
            continue
        try:
            theirs = scipy.io.loadmat(path)
        except Exception:  # noqa: BLE001 - made to fail
            continue
        for name, array in arrays_in(path).items():
            if name in theirs:
                np.testing.assert_array_equal(read_array(path, array), theirs[name])
                seen += 1
    assert seen > 10


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_damaged_anywhere_is_read_or_refused(tmp_path: Path, *, compressed: bool) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"psf": RNG.random((6, 5)), "z": 1.0}, do_compression=compressed)
    sound = path.read_bytes()
    refused = 0
    for at in range(116, len(sound), 3):
        for byte in (0, 0xFF, sound[at] ^ 1):
            path.write_bytes(sound[:at] + bytes([byte]) + sound[at + 1 :])
            try:
                assert read_stack(path).pixels.size < 1e6
            except FileError:
                refused += 1
    assert refused > 20
