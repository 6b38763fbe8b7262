"""Arrays with names and axes: HDF5, MATLAB and OME-Zarr of other programs."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
import zarr

from instrument.files.errors import FileError
from instrument.files.images import read, read_image, read_stack

RNG = np.random.default_rng(3)
STACK = RNG.integers(0, 4096, (5, 8, 6)).astype(np.uint16)
PICTURE = STACK[0]


def test_arrays_of_hdf5_and_matlab_files(tmp_path: Path) -> None:
    h5 = tmp_path / "psfs.h5"
    with h5py.File(h5, "w") as file:
        file["measurement/psf"] = STACK
        file["gain"] = 3.0
    np.testing.assert_array_equal(read_stack(h5).pixels, STACK)
    with h5py.File(tmp_path / "t z y x c.h5", "w") as file:
        file["exported_data"] = STACK[None, ..., None]
    np.testing.assert_array_equal(read_stack(tmp_path / "t z y x c.h5").pixels, STACK)
    with h5py.File(h5, "a") as file:
        file["photograph"] = PICTURE
    with pytest.raises(FileError, match=r"2 arrays that could be images: measurement/psf \(5, 8, 6\), photo"):
        read(h5)
    np.testing.assert_array_equal(read_image(f"{h5}::photograph").pixels, PICTURE)
    with pytest.raises(FileError, match="holds no array called psf"):
        read_image(f"{h5}::psf")
    PICTURE.tofile(tmp_path / "elsewhere")
    with h5py.File(tmp_path / "out.h5", "w") as file:
        file.create_dataset("psf", (8, 6), "u2", external=[(str(tmp_path / "elsewhere"), 0, PICTURE.nbytes)])
    with pytest.raises(FileError, match="keeps the numbers of psf in other files"):
        read(tmp_path / "out.h5")
    with h5py.File(tmp_path / "named.h5", "w", userblock_size=1024) as file:
        file["psf"] = np.moveaxis(STACK, 0, -1)
        for number, name in enumerate("yxz"):
            file["psf"].dims[number].label = name
        file["empty"] = h5py.Empty("f4")
    np.testing.assert_array_equal(read_stack(tmp_path / "named.h5").pixels, STACK)
    mat = tmp_path / "psfs.mat"
    scipy.io.savemat(mat, {"psf": np.moveaxis(STACK, 0, -1), "z": np.arange(5)}, do_compression=True)
    np.testing.assert_array_equal(read_stack(mat).pixels, STACK)
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        file["psf"] = np.moveaxis(STACK, 0, -1).T  # as MATLAB 7.3 has it
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "new.mat").write_bytes(header.ljust(512, b"\0") + (tmp_path / "new.mat").read_bytes()[512:])
    np.testing.assert_array_equal(read_stack(tmp_path / "new.mat").pixels, STACK)
    for path in (h5, mat):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(FileError, match="damaged or unusual"):
            read(path)


def test_ome_zarr_of_both_versions(tmp_path: Path) -> None:
    for version in (2, 3):
        folder = tmp_path / f"{version}.zarr"
        group = zarr.open_group(folder, mode="w", zarr_format=version)
        array = group.create_array("0", shape=(1, 1, 5, 8, 6), dtype="uint16", chunks=(1, 1, 1, 8, 6))
        array[:] = STACK[None, None]
        axes = [{"name": name, "unit": "micrometer"} if name == "z" else {"name": name} for name in "tczyx"]
        scale = [{"type": "scale", "scale": [1.0, 1.0, 2.5, 1.0, 1.0]}]
        facts = {
            "multiscales": [{"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": scale}]}]
        }
        group.attrs.update(facts if version == 2 else {"ome": facts})
        stack = read(folder)
        np.testing.assert_array_equal(stack.pixels, STACK)
        assert "planes every 2.5 um as it says" in stack.notes


def test_series_of_bioformats2raw(tmp_path: Path) -> None:
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    group.attrs["bioformats2raw.layout"] = 3
    axes = [{"name": name, "type": "space"} for name in "zyx"]
    said = [{"version": "0.4", "axes": axes, "datasets": [{"path": "0"}]}]
    for number in (0, 1):
        series = group.create_group(str(number))
        series.attrs["multiscales"] = said
        series.create_array("0", shape=STACK.shape, dtype=STACK.dtype)[...] = STACK
        if not number:
            stack = read_stack(tmp_path / "a.zarr")
            np.testing.assert_array_equal(stack.pixels, STACK)
            assert stack.notes == ("its image series 0 taken",)
    with pytest.raises(FileError, match=r"holds 2 image series\. Name one: .*a\.zarr/0, .*a\.zarr/1\."):
        read_stack(tmp_path / "a.zarr")
    np.testing.assert_array_equal(read_stack(tmp_path / "a.zarr" / "1").pixels, STACK)


def test_axes_and_steps_that_zarr_tells(tmp_path: Path) -> None:
    """Transformations of all levels follow those of one; a unit that is not told is not guessed."""
    group = zarr.open_group(tmp_path / "film.zarr", mode="w", zarr_format=2)
    group.create_array("0", shape=STACK.shape, dtype=STACK.dtype)[...] = STACK
    told = [{"name": "t", "unit": "second"}, {"name": "y"}, {"name": "x", "unit": "nanometer"}]
    level = {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": [1.0, 6500.0, 6500.0]}]}
    every = [
        {"type": "scale", "scale": [0.05, 1.0, 1.0]},
        {"type": "translation", "translation": [3.0, 0, 0]},
    ]
    image = {"version": "0.4", "axes": told, "datasets": [level], "coordinateTransformations": every}
    group.attrs["multiscales"] = [image]
    film = read_stack(tmp_path / "film.zarr")
    assert film.metadata == pytest.approx({"frame_period_s": 0.05, "pixel_pitch_um": 6.5})
    array = zarr.create_array(
        tmp_path / "a.zarr", shape=(8, 6, 5), dtype="u2", dimension_names=["y", "x", "z"]
    )
    array[...] = np.moveaxis(STACK, 0, -1)
    np.testing.assert_array_equal(read_stack(tmp_path / "a.zarr").pixels, STACK)
    group = zarr.open_group(tmp_path / "several.zarr", mode="w", zarr_format=3)
    group.create_array("psf", shape=STACK.shape, dtype=STACK.dtype)[...] = STACK
    with pytest.raises(
        FileError, match=r"no OME-Zarr image\. Name what is meant of it: .*several\.zarr/psf\."
    ):
        read_stack(tmp_path / "several.zarr")
    np.testing.assert_array_equal(read_stack(tmp_path / "several.zarr" / "psf").pixels, STACK)
    with zarr.storage.ZipStore(tmp_path / "a.zarr.zip", mode="w") as store:
        zarr.create_array(store, shape=STACK.shape, dtype=STACK.dtype)[...] = STACK
    with pytest.raises(FileError, match=r"zipped Zarr, which is not read\. Unpack it"):
        read_stack(tmp_path / "a.zarr.zip")


def test_labels_beside_an_image_may_have_larger_chunks(tmp_path: Path) -> None:
    image = np.arange(64 * 96, dtype=np.uint8).reshape(64, 96)
    group = zarr.open_group(tmp_path / "a.zarr", mode="w")
    group.create_array("0", data=image, chunks=(16, 16))
    axes = [{"name": "y", "type": "space"}, {"name": "x", "type": "space"}]
    scales = [{"type": "scale", "scale": [1.0, 1.0]}]
    datasets = [{"path": "0", "coordinateTransformations": scales}]
    group.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": axes, "datasets": datasets}]}
    cells = RNG.integers(0, 1 << 31, (1024, 1024)).astype(np.uint32) // (1 << 24)
    group.create_array("labels/cells", data=cells, chunks=(1024, 1024), compressors=zarr.codecs.GzipCodec())
    np.testing.assert_array_equal(read_image(tmp_path / "a.zarr").pixels, image)


@pytest.mark.parametrize("name", ["s.tif", "s.npy", "s.npz", "s.h5", "s.mat", "s.zarr"])
def test_a_stack_where_one_picture_is_wanted_is_refused_before_its_pixels_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path, stack = tmp_path / name, np.zeros((5, 30, 40), np.uint16)
    match path.suffix:
        case ".tif":
            tifffile.imwrite(path, stack)
            monkeypatch.setattr(tifffile.TiffPageSeries, "asarray", lambda *_: pytest.fail("read"))
        case ".npy" | ".npz":
            np.save(path, stack) if path.suffix == ".npy" else np.savez(path, stack)
            monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("read"))
        case ".h5":
            with h5py.File(path, "w") as file:
                file["image"] = stack
            monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda *_: pytest.fail("read"))
        case ".mat":
            scipy.io.savemat(path, {"image": np.moveaxis(stack, 0, -1)})
            monkeypatch.setattr("instrument.files.matlab.read_array", lambda *_: pytest.fail("read"))
        case _:
            zarr.save_array(path, stack)
            monkeypatch.setattr(zarr.Array, "__getitem__", lambda *_: pytest.fail("read"))
    with pytest.raises(FileError, match=rf"{name}: holds 5 images; a single one is expected\..* mean\.$"):
        read_image(path)


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".mat"])
@pytest.mark.parametrize(
    ("name", "depths"), [("z_um", [1e4, 2e4, 3e4, 5e4]), ("depths_mm", [10.0, 20.0, 30.0, 50.0])]
)
def test_an_array_beside_a_stack_tells_its_depths(
    tmp_path: Path, suffix: str, name: str, depths: list[float]
) -> None:
    stack = np.random.default_rng(0).integers(0, 999, (4, 20, 30)).astype(np.uint16)
    path = tmp_path / f"psfs{suffix}"
    if suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["psfs"], file[name] = stack, depths
    elif suffix == ".npz":
        np.savez(path, **{"psfs": stack, name: np.array(depths)})
    else:
        scipy.io.savemat(path, {"psfs": np.moveaxis(stack, 0, -1), name: np.array(depths)})
    read = read_stack(f"{path}::psfs")
    assert np.array_equal(read.pixels, stack)
    assert read.metadata["depths_um"] == [1e4, 2e4, 3e4, 5e4]
    assert any("10" in note and "50" in note for note in read.notes), read.notes


@pytest.mark.parametrize(
    ("beginning", "says"),
    [
        (b"RIFF\x10\0\0\0WEBPVP8 ", "is a WebP picture, .* save it as PNG"),
        (b"\0\0\0\x18ftypheic", "is a HEIC picture"),
        (b"RIFF\x10\0\0\0AVI LIST", "is an AVI film, which is not read, compressed or not"),
        (b"\0\0\0\x18ftypisom", "is a compressed film"),
        (b"ZISRAWFILE", "is a Zeiss CZI file, .* Export it as OME-TIFF"),
        (b"SIMPLE  =                    T", "is a FITS file. Make an array"),
    ],
)
def test_others_files_are_called_by_what_they_are(tmp_path: Path, beginning: bytes, says: str) -> None:
    (tmp_path / "photo").write_bytes(beginning + bytes(100))
    with pytest.raises(FileError, match=says):
        read_image(tmp_path / "photo")
