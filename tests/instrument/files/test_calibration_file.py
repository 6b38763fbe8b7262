"""A calibration comes back from disk as it was, others can read it, and damage is named."""

from __future__ import annotations

import errno
import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from instrument.files import atomic, calibration_file
from instrument.files.calibration_file import (
    CalibrationFileError,
    calibration_name,
    check_calibration,
    is_calibration,
    load_calibration,
    save_calibration,
)
from recon.types import Calibration, Geometry


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def make(n_sources: int = 3, n_channels: int = 2, *, background: bool = True) -> Calibration:
    random = np.random.default_rng(n_sources)
    positions = np.array([[0.0, np.nan, 1e5 * (i + 1)] for i in range(n_sources)])
    return Calibration(
        psfs=random.random((n_sources, n_channels, 12, 20), np.float32),
        source_positions_um=positions,
        background=random.random((n_channels, 12, 20), np.float32) if background else None,
        geometry=Geometry(13.0, 8.9, (5.5, 7.5), 532.0) if background else Geometry(),
        quality={"good": True, "planes": [{"snr": np.float32(12.5), "step_px": float("nan")}]},
        provenance={"simulated": True, "sweep": {"planes": n_sources}},
    )


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("shape", [(3, 2), (1, 1), (5, 3)])
def test_it_comes_back_as_it_was(tmp_path: Path, shape: tuple[int, int], background: bool) -> None:
    saved = make(*shape, background=background)
    path = save_calibration(saved, tmp_path / "new" / "calibration")
    loaded = load_calibration(path)
    assert np.array_equal(loaded.psfs, saved.psfs)
    assert loaded.psfs.flags.c_contiguous
    assert np.array_equal(loaded.source_positions_um, saved.source_positions_um, equal_nan=True)
    assert loaded.geometry == saved.geometry
    assert loaded.provenance == saved.provenance
    assert loaded.quality == {"good": True, "planes": [{"snr": 12.5, "step_px": None}]}
    if saved.background is None:
        assert loaded.background is None
    else:
        assert loaded.background is not None
        assert np.array_equal(loaded.background, saved.background)
    assert is_calibration(path)
    assert names(path.parent) == ["calibration"], "nothing is left beside it"


def test_its_pictures_are_valid_ome_zarr(tmp_path: Path) -> None:
    from ome_zarr_models.v05.image import Image

    path = save_calibration(make(), tmp_path / "c")
    for name, axes in (("psfs", "czyx"), ("background", "cyx")):
        group = zarr.open_group(path / f"{name}.ome.zarr", mode="r")
        image = Image.from_zarr(group)
        multiscale = image.attributes.ome.multiscales[0]
        assert "".join(axis.name for axis in multiscale.axes) == axes
        assert multiscale.datasets[0].coordinateTransformations[0].scale[-2:] == [13.0, 13.0]


def test_an_existing_calibration_is_replaced_only_on_request(tmp_path: Path) -> None:
    path = save_calibration(make(), tmp_path / "c")
    with pytest.raises(CalibrationFileError, match=r"exists already.* --force, in Python overwrite=True"):
        save_calibration(make(1), path)
    assert len(load_calibration(path).psfs) == 3
    save_calibration(make(1), path, overwrite=True)
    assert len(load_calibration(path).psfs) == 1
    assert names(tmp_path) == ["c"]


def test_what_is_no_calibration_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("precious")
    with pytest.raises(CalibrationFileError, match="no calibration"):
        save_calibration(make(), tmp_path / "thesis", overwrite=True)
    assert (tmp_path / "thesis" / "chapter1.tex").read_text() == "precious"


@pytest.mark.parametrize("overwrite", [True, False])
def test_a_full_disk_leaves_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overwrite: bool
) -> None:
    if overwrite:
        save_calibration(make(), tmp_path / "c")
    before = names(tmp_path)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(calibration_file, "_write_ome_zarr", full)
    with pytest.raises(CalibrationFileError, match="No space left"):
        save_calibration(make(1), tmp_path / "c", overwrite=overwrite)
    assert names(tmp_path) == before
    if overwrite:
        assert len(load_calibration(tmp_path / "c").psfs) == 3


def test_a_rename_that_fails_brings_the_old_one_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_calibration(make(), tmp_path / "c")
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.suffix == ".part":
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    monkeypatch.setattr(atomic, "_exchanged", lambda *_: False)  # as on a disk that cannot
    with pytest.raises(CalibrationFileError, match="Input/output"):
        save_calibration(make(1), tmp_path / "c", overwrite=True)
    assert len(load_calibration(tmp_path / "c").psfs) == 3
    assert names(tmp_path) == ["c"]


def test_a_wrong_path_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationFileError, match=r"nowhere: does not exist"):
        load_calibration(tmp_path / "nowhere")
    with pytest.raises(CalibrationFileError, match=r"holds no calibration\.json"):
        load_calibration(tmp_path)
    (tmp_path / "file").write_text("x")
    with pytest.raises(CalibrationFileError, match="is no calibration"):
        load_calibration(tmp_path / "file")


REQUIRED = ("shape", "source_positions_um", "geometry", "quality", "provenance", "sha256")


def edit(path: Path, changes: dict[str, Any] | str) -> None:
    """Change some of a record, or take a field away."""
    record = json.loads((path / "calibration.json").read_text())
    if isinstance(changes, str):
        del record[changes]
    else:
        record |= changes
    (path / "calibration.json").write_text(json.dumps(record))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "holiday photos"}, "'format' is 'holiday photos'"),
        ({"version": 99}, "version 99 is not known.*Update"),
        ({"source_positions_um": [[0, 0, 1]]}, "is a damaged calibration"),
        ({"geometry": {"pixel_pitch_um": "blue"}}, "is a damaged calibration"),
        ({"source_positions_um": [[0, 0, 1], [0, 0, 2], [0, 0, "far"]]}, "is a damaged calibration"),
        ({"shape": [10**200, 2, 12, 20]}, "is a damaged calibration"),
        ({"sha256": {}}, "is a damaged calibration: lacks 'psfs"),
        ({"shape": [3, 2, 20, 12]}, r"is a damaged calibration: its PSFs are \(3, 2, 12, 20\)"),
        ({"quality": "good"}, "is a damaged calibration: quality must be"),
        *((lacking, f"is a damaged calibration: lacks '{lacking}'") for lacking in REQUIRED),
    ],
)
def test_a_changed_description_is_named_by_who_loads_it_and_by_who_checks_it(
    tmp_path: Path, changes: dict[str, Any] | str, message: str
) -> None:
    path = save_calibration(make(), tmp_path / "c")
    edit(path, changes)
    with pytest.raises(CalibrationFileError, match=message):
        load_calibration(path)
    with pytest.raises(CalibrationFileError, match=message):
        check_calibration(path)
    if changes != {"shape": [3, 2, 20, 12]}:  # which only the arrays contradict
        with pytest.raises(CalibrationFileError, match=r"is a damaged calibration|'format' is|not known"):
            check_calibration(path, read=False)


def test_a_sound_calibration_is_checked_a_psf_at_a_time(tmp_path: Path) -> None:
    for saved in (make(), make(background=False)):
        path = save_calibration(saved, tmp_path / "small", overwrite=True)
        check_calibration(path)
        check_calibration(path, read=False)
    psfs = np.random.default_rng(0).random((96, 1, 256, 256), np.float32)
    path = save_calibration(Calibration(psfs, np.zeros((96, 3))), tmp_path / "large")
    tracemalloc.start()
    check_calibration(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < psfs.nbytes / 2


def test_broken_json_is_named(tmp_path: Path) -> None:
    path = save_calibration(make(), tmp_path / "c")
    (path / "calibration.json").write_text('{"format": ')
    with pytest.raises(CalibrationFileError, match="no valid JSON"):
        load_calibration(path)
    (path / "calibration.json").write_text("[]")
    with pytest.raises(CalibrationFileError, match="no JSON object"):
        load_calibration(path)


def test_damaged_or_missing_data_are_named(tmp_path: Path) -> None:
    path = save_calibration(make(), tmp_path / "c")
    chunk = next(
        p for p in sorted((path / "psfs.ome.zarr" / "0").rglob("*")) if p.suffix != ".json" and p.is_file()
    )
    good = chunk.read_bytes()
    chunk.write_bytes(good[: len(good) // 2])
    with pytest.raises(CalibrationFileError, match=r"psfs\.ome\.zarr: .*damaged"):
        load_calibration(path)
    chunk.unlink()  # zarr reads a missing chunk as zeros: only the checksum tells
    with pytest.raises(CalibrationFileError, match=r"psfs\.ome\.zarr: does not have the checksum"):
        load_calibration(path)


def test_a_folder_without_permission_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(CalibrationFileError, match="cannot be written: Permission denied"):
        save_calibration(make(), tmp_path / "c")


def test_a_calibration_is_called_by_its_own_folder_or_the_sweep_that_took_it() -> None:
    assert calibration_name(Path("runs/axial/calibration")) == "axial"
    assert calibration_name(Path("own/mine")) == "mine"
