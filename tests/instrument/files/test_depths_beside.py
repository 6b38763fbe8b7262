"""Arrays that tell where the images of a stack lie: taken, or refused by name; never silently otherwise."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

from instrument.files.errors import FileError
from instrument.files.images import ImageFile, read, read_image, read_stack
from recon.arrays import Array

STACK = np.random.default_rng(0).integers(0, 999, (5, 20, 30)).astype(np.uint16)


def written(folder: Path, suffix: str, **arrays: Any) -> str:
    """Write a stack with arrays beside it; return how it is named."""
    path = folder / f"psfs{suffix}"
    if suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, array in {"psfs": STACK, **arrays}.items():
                file[name] = array.astype("S") if array.dtype.kind == "U" else array
    elif suffix == ".npz":
        np.savez(path, **{"psfs": STACK, **arrays})
    else:
        scipy.io.savemat(path, {"psfs": np.moveaxis(STACK, 0, -1), **arrays})
    return f"{path}::psfs"


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".mat"])
@pytest.mark.parametrize(
    ("name", "told", "found"),
    [
        ("z_um", np.array([1, 2, np.nan, 4, 5]), "it says nan for image 2"),
        ("depths_mm", np.array([1, 2, 3, 4, np.inf]), "it says inf for image 4"),
        ("z_mm", np.array([1e308, 2, 3, 4, 5]), r"it says 1e\+308 for image 0"),
        ("z_um", np.array([1, 2, 3, 4, 5j]), "it .*complex|it cannot be read as such"),
        ("z_um", np.arange(4.0), "it has (1 x )?4 of them"),
        ("z_um", np.arange(10.0).reshape(5, 2), "it has 5 x 2 of them"),
        ("z_um", np.array(list("abcde")), "it (holds|is) text|it cannot be read as such"),
        ("z_um", np.array([True, False, True, False, True]), "it holds booleans|it cannot be read as such"),
        ("z_um", np.array([1, None, 3, 4, 5], object), "it cannot be read as such: .* objects of Python's"),
    ],
)
def test_depths_that_are_none_are_refused_by_the_arrays_name(
    tmp_path: Path, suffix: str, name: str, told: Array, found: str
) -> None:
    if (suffix, told.dtype.kind) in ((".h5", "O"), (".mat", "O"), (".mat", "b")):
        return  # the format has none, or does not tell it from others
    file = written(tmp_path, suffix, **{name: told})
    with pytest.raises(FileError, match=f"its array {name} .* 5 finite numbers are expected, and {found}"):
        read_stack(file)
    with pytest.raises(FileError, match=f"its array {name} tells where the images lie"):
        read(file)


def test_two_arrays_that_disagree_are_refused_and_two_that_agree_are_not(tmp_path: Path) -> None:
    depths_mm = np.array([10, 20, 30, 40, 50.1])
    file = written(tmp_path, ".npz", z_mm=depths_mm.astype(np.float32), depths_um=1e3 * depths_mm)
    assert read_stack(file).metadata["depths_um"] == pytest.approx((1e3 * depths_mm).tolist())
    file = written(tmp_path, ".npz", z_mm=depths_mm, depths_um=1e3 * depths_mm[::-1])
    with pytest.raises(
        FileError, match=r"depths_um and its array z_mm disagree .* image 0 is at 50100 um by"
    ):
        read_stack(file)


def test_what_the_side_car_tells_is_checked_in_the_same_way_and_said(tmp_path: Path) -> None:
    def with_side_car(told: object, **arrays: Any) -> ImageFile:
        file = written(tmp_path, ".npz", **arrays)
        (tmp_path / "psfs.json").write_text(json.dumps({"depths_um": told}))
        return read_stack(file)

    assert with_side_car([1, 2, 3, 4, 5]).metadata["depths_um"] == [1, 2, 3, 4, 5]
    for wrong in (
        [1, 2],
        ["a"] * 5,
        [[1], [1, 2]],
        "a",
        {"a": 1},
        [1, 2, None, 4, 5],
        [1, 2, float("nan"), 4, 5],
    ):
        stack = with_side_car(wrong)
        assert "depths_um" not in stack.metadata
        assert any("metadata tells where" in note and note.endswith(": not taken") for note in stack.notes)
    with pytest.raises(FileError, match="its depths_um of its metadata and its array z_um disagree"):
        with_side_car([1, 2, 3, 4, 5], z_um=np.arange(5.0))


def test_depths_of_another_stack_and_one_number_for_all_are_not_taken(tmp_path: Path) -> None:
    other = np.ones((4, 20, 30), np.float32)
    stack = read_stack(written(tmp_path, ".npz", other=other, z_um=np.arange(4.0)))
    assert "depths_um" not in stack.metadata
    stack = read_stack(written(tmp_path, ".npz", z_um=np.array(7.0)))
    assert "depths_um" not in stack.metadata
    assert "its array z_um is one number for 5 images: not taken" in stack.notes


def test_three_planes_with_their_depths_beside_them_are_no_colours(tmp_path: Path) -> None:
    three = STACK[:3]
    np.savez(tmp_path / "a.npz", psfs=three)
    assert read(f"{tmp_path / 'a.npz'}::psfs").is_colour
    np.savez(tmp_path / "a.npz", psfs=three, z_um=1e4)
    assert read(f"{tmp_path / 'a.npz'}::psfs").is_colour
    np.savez(tmp_path / "a.npz", psfs=three, z_mm=[10.0, 20.0, 35.0])
    assert read(f"{tmp_path / 'a.npz'}::psfs").metadata["depths_um"] == [1e4, 2e4, 3.5e4]
    with pytest.raises(FileError, match="holds 3 images; a single one is expected"):
        read_image(f"{tmp_path / 'a.npz'}::psfs")
    np.savez(tmp_path / "a.npz", psfs=three, z_mm=[10.0, 20.0, 35.0, 40.0])
    with pytest.raises(FileError, match=r"its array z_mm .* 3 finite numbers are expected, and it has 4"):
        read(f"{tmp_path / 'a.npz'}::psfs")


def test_four_planes_of_numpys_are_images_and_transparency_comes_last(tmp_path: Path) -> None:
    """Four depths are likelier than colours and transparency in front; behind it nothing else is likely."""
    pixels = np.random.default_rng(0).integers(0, 999, (4, 12, 16)).astype(np.uint16)
    np.save(tmp_path / "planes.npy", pixels)
    np.save(tmp_path / "rgba.npy", np.moveaxis(pixels, 0, -1))
    np.save(tmp_path / "rgb.npy", np.moveaxis(pixels[:3], 0, -1))
    with pytest.raises(FileError, match="holds 4 images; a single one is expected"):
        read_image(tmp_path / "planes.npy")
    assert read(tmp_path / "planes.npy").pixels.shape == (4, 12, 16)
    for name, notes in (("rgba.npy", ("alpha channel left out",)), ("rgb.npy", ())):
        for found, shown in ((read_image(tmp_path / name), ...), (read_stack(tmp_path / name), 0)):
            np.testing.assert_array_equal(found.pixels[shown], np.moveaxis(pixels[:3], 0, -1))
            assert found.notes == notes


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_matlabs_texts_and_cells_that_are_called_depths_are_not_passed_over(
    tmp_path: Path, version: str
) -> None:
    cell = np.empty((1, 5), object)
    cell[0] = [f"{z} mm" for z in (10, 20, 30, 40, 50)]

    def holding(**others: Any) -> str:
        path = tmp_path / "a.mat"
        stack = np.moveaxis(STACK, 0, -1)
        if version == "5":
            scipy.io.savemat(path, {"psfs": stack, **others})
            return f"{path}::psfs"
        path.unlink(missing_ok=True)
        with h5py.File(path, "w") as file:
            file["psfs"] = stack.T
            for name, other in others.items():
                file[name] = np.full((5, 1), 77, np.uint16)
                file[name].attrs["MATLAB_class"] = np.bytes_("cell" if other is cell else "char")
        return f"{path}::psfs"

    for told, words in ((cell, "a cell"), ("abcde", "text")):
        with pytest.raises(FileError, match=f"its array z_mm tells where the images lie, .* it is {words}"):
            read_stack(holding(z_mm=told))
        for name in ("depths", "Z", "z_cm"):
            said = (
                f"its {name} is {words} and tells no depths: numbers are taken that are called z_mm or z_um"
            )
            assert said in read_stack(holding(**{name: told})).notes


def test_numbers_that_may_be_depths_and_are_not_called_so_are_named(tmp_path: Path) -> None:
    stack = read_stack(
        written(tmp_path, ".npz", z=np.arange(5.0), pos_nm=np.arange(4.0), gain=np.arange(5.0))
    )
    told = [note for note in stack.notes if "tells no depths" in note]
    assert told == ["its z tells no depths: numbers are taken that are called z_mm or z_um"]


def test_three_planes_of_matlabs_are_images_where_a_stack_is_asked_for(tmp_path: Path) -> None:
    three = np.moveaxis(STACK[:3], 0, -1)
    scipy.io.savemat(tmp_path / "a.mat", {"psfs": three})
    assert read(tmp_path / "a.mat").is_colour
    np.testing.assert_array_equal(read_stack(tmp_path / "a.mat").pixels, STACK[:3])
    scipy.io.savemat(tmp_path / "a.mat", {"psfs": three, "z_mm": [10.0, 20.0, 35.0]})
    assert read(f"{tmp_path / 'a.mat'}::psfs").metadata["depths_um"] == [1e4, 2e4, 3.5e4]
