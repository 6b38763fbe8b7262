"""Damaged, hostile and special files end in one sentence, soon, without much memory."""

from __future__ import annotations

import io
import json
import lzma
import os
import re
import signal
import struct
import tracemalloc
import zipfile
import zlib
from bisect import bisect
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import zarr

from instrument.bench.config_file import load_config
from instrument.display.spots import read_spots
from instrument.files import pieces, reading
from instrument.files.atomic import write_bytes
from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image, write_image
from instrument.files.ome_zarr import ome_attributes
from instrument.files.record import of_kind
from instrument.plan.model import load_plan
from instrument.reconstruction.film import Film
from instrument.reconstruction.patterned import _patterns_from_file
from instrument.reconstruction.stored_result import open_result
from instrument.tasks.task import guarded
from instrument.volumes.opening import open_volume
from tests.fuzz import __main__ as fuzzer
from tests.fuzz.__main__ import CORPUS, fuzz
from tests.fuzz.readers import READERS, Reader


@pytest.mark.parametrize("name", READERS)
def test_a_short_fuzz_and_all_that_broke_a_reader_before(name: str) -> None:
    kept = len(list((CORPUS / name).glob("*")))
    count, found = fuzz(name, seconds=30, runs=kept + 12, seed=2, keep=False)
    assert count
    assert not found, found


def test_a_reader_that_takes_too_long_is_told_with_the_place_and_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(_path: Path) -> None:
        while True:
            of_kind({"a": [1, 2, 3]}, {"a": [int]})

    monkeypatch.setattr(fuzzer, "MOST_SECONDS", -0.95)  # ended a second later: a twentieth
    before = signal.signal(signal.SIGPROF, fuzzer._too_slow)
    try:
        words = fuzzer.trouble(Reader(lambda folder: folder, slow), tmp_path)
    finally:
        signal.signal(signal.SIGPROF, before)
    assert re.fullmatch(
        r"takes too long: [0-9.]+ s of the processor, at (record|test_readers).py:[0-9]+", words
    )


@pytest.mark.parametrize("read", [load_config, load_plan, read_image, open_volume, open_result])
@pytest.mark.parametrize("suffix", [".toml", ".json", ".tif", ".npy", ".png"])
def test_a_pipe_and_an_endless_device_are_refused_at_once(tmp_path: Path, read: object, suffix: str) -> None:
    pipe, endless = tmp_path / f"pipe{suffix}", tmp_path / f"zero{suffix}"
    os.mkfifo(pipe)
    endless.symlink_to("/dev/zero")
    for path in (pipe, endless):
        with pytest.raises(BenchError) as caught:
            read(path)  # type: ignore[operator]
        assert (
            read is not load_plan or suffix not in (".toml", ".json") or "pipe or device" in str(caught.value)
        )


def test_a_list_of_spots_and_patterns_are_read_like_other_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    with (tmp_path / "nothing").open("wb") as file:
        file.truncate(20 << 30)
    with (tmp_path / "claims").open("wb") as file:
        huge = {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
        np.lib.format.write_array_header_1_0(file, huge)
    for name in ("pipe", "zero", "nothing", "claims"):
        with pytest.raises(FileError):
            _patterns_from_file(tmp_path / name, (3, 12, 16))
        with pytest.raises(FileError):
            read_spots(tmp_path / name)
    spots = tmp_path / "spots.csv"
    spots.write_text("y,x\n0.2,0.3\n")
    with guarded({}):
        read_spots(spots)
        with pytest.raises(FileError, match="no output replaces an input"):
            write_bytes(spots, b"a preview")


def test_what_is_not_there_yet_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(pipe := tmp_path / "plan.toml")  # like /proc/kmsg, which says that it is a plain file
    monkeypatch.setattr(reading, "require_file", lambda *_, **__: 0)
    writer = os.open(pipe, os.O_RDWR)
    with pytest.raises(BenchError, match="might never end"):
        load_plan(pipe)
    os.close(writer)


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


def untold(blocks: int) -> bytes:
    """Return a Zstandard frame of so many blocks of 128 kB of zeros each, which does not tell its size."""
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    last = (1 << 1 | 1).to_bytes(3, "little") + b"\0"
    return b"\x28\xb5\x2f\xfd\x00\x58" + blocks * block + last


@pytest.mark.parametrize("kind", ["hdf5", "gzip", "zstd", "untold", "blosc"])
def test_a_piece_that_inflates_beyond_what_its_array_holds_is_refused(tmp_path: Path, kind: str) -> None:
    path, whole = tmp_path / kind, np.arange(6144, dtype=np.uint16).reshape(64, 96)
    inflated = bytes(40 << 20)
    if kind == "hdf5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file.create_dataset("image", data=whole, chunks=(64, 96), compression="gzip")
    else:
        codec = {"gzip": zarr.codecs.GzipCodec, "blosc": zarr.codecs.BloscCodec}.get(
            kind, zarr.codecs.ZstdCodec
        )
        zarr.create_array(path, shape=(64, 96), dtype="u2", chunks=(64, 96), compressors=codec())[:] = whole
    assert (read_image(path).pixels == whole).all()
    if kind == "hdf5":
        with h5py.File(path, "r+") as file:
            file["image"].id.write_direct_chunk((0, 0), zlib.compress(inflated))
    else:
        packed = {"gzip": numcodecs.GZip(), "blosc": numcodecs.Blosc()}.get(kind, numcodecs.Zstd())
        (path / "c/0/0").write_bytes(untold(2200) if kind == "untold" else packed.encode(inflated))
    with pytest.raises(BenchError, match=r"inflates to over 1.07 MB, for 12.3 kB of numbers"):
        read_image(path)


@pytest.mark.parametrize("what", ["array", "piece"])
def test_what_lzf_shrinks_to_nothing_is_refused_by_its_size(tmp_path: Path, what: str) -> None:
    """Zeros by LZF are an 88th, which is less than what other compressions' files are refused for."""
    h5py = pytest.importorskip("h5py")
    path, zeros = tmp_path / "lzf.h5", b"\0\0" + b"\xe0\xff\0"  # a zero, then 264 more by each three bytes
    with h5py.File(path, "w") as file:
        shape = (8000, 9000) if what == "array" else (1000, 1000)
        stored = file.create_dataset("image", shape, "u2", chunks=(1000, 1000), compression="lzf")
        for at in np.ndindex(shape[0] // 1000, shape[1] // 1000):
            stored.id.write_direct_chunk(
                (1000 * at[0], 1000 * at[1]), zeros + zeros[2:] * (7575 if what == "array" else 1_100_000)
            )
    with pytest.raises(
        BenchError, match="says that it holds 144 MB" if what == "array" else "inflates to over 268 MB"
    ):
        read_image(path)


def test_what_szip_says_to_become_far_more_is_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    if not h5py.h5z.filter_avail(h5py.h5z.FILTER_SZIP):
        pytest.skip("this HDF5 is made without szip")
    path, whole = tmp_path / "szip.h5", np.arange(6144, dtype=np.uint16).reshape(64, 96)
    with h5py.File(path, "w") as file:
        options = {"chunks": (64, 96), "compression": "szip", "fletcher32": True}
        stored = file.create_dataset("image", data=whole, **options).id
    np.testing.assert_array_equal(read_image(path).pixels, whole)
    with h5py.File(path, "r+") as file:
        stored = file["image"].id
        data = stored.read_direct_chunk((0, 0))[1]
        stored.write_direct_chunk((0, 0), (3 << 30).to_bytes(4, "little") + data[4:])
    with pytest.raises(BenchError, match=r"inflates to over 1.07 MB, for 12.3 kB of numbers"):
        read_image(path)


@pytest.mark.parametrize("shuffle", [False, True])
def test_frames_by_lzf_are_read_without_a_walk_through_their_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, shuffle: bool
) -> None:
    """Which takes ten times as long as to inflate them."""
    h5py = pytest.importorskip("h5py")
    path, frame = tmp_path / "lzf.h5", np.random.default_rng(0).poisson(900, (1600, 2000)).astype(np.uint16)
    with h5py.File(path, "w") as file:
        stored = file.create_dataset(
            "image", data=frame, chunks=frame.shape, compression="lzf", shuffle=shuffle
        )
        assert 88 * stored.id.get_storage_size() > 1 << 28, "its size alone does not clear it"
    monkeypatch.setattr("instrument.files.pieces._lzf_beyond", lambda *_: pytest.fail("walked"))
    np.testing.assert_array_equal(read_image(path).pixels, frame)


def test_a_walk_through_lzf_ends_where_what_follows_cannot_make_it_too_much(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pieces, "_BLOCK_BYTES", 64)
    looked: list[int] = []

    class Watched(bytes):
        def __getitem__(self, at: Any) -> Any:
            looked.append(at if isinstance(at, int) else 0)
            return super().__getitem__(at)

    data = Watched(np.random.default_rng(0).integers(0, 256, 2000).astype(np.uint8).tobytes())
    left = pieces._lzf_most(data)
    whole = [1 << 40] * len(left)
    becomes = bisect(range(left[0]), 0, key=lambda most: not pieces._lzf_beyond(data, most, whole))
    assert 2000 < becomes < left[0] / 2
    for most in (becomes - 1, becomes):
        assert pieces._lzf_beyond(data, most, left) == (most < becomes)
    looked.clear()
    assert not pieces._lzf_beyond(data, int(0.8 * left[0]), left)
    assert max(looked) < 1000


@pytest.mark.parametrize("compression", [8, 34925])
def test_a_tiffs_strip_is_inflated_as_far_as_it_holds(tmp_path: Path, compression: int) -> None:
    whole, zeros = np.arange(6144, dtype=np.uint16).tobytes(), bytes(60 << 20)
    pack = zlib.compress if compression == 8 else lzma.compress
    facts = [(256, 96), (257, 64), (258, 16), (259, compression), (262, 1), (273, 8), (277, 1), (278, 64)]
    for packed in (pack(whole), pack(whole + zeros)):
        entries = [struct.pack("<HHII", tag, 4, 1, value) for tag, value in [*facts, (279, len(packed))]]
        pages = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
        (path := tmp_path / "a.tif").write_bytes(
            b"II*\0" + struct.pack("<I", 8 + len(packed)) + packed + pages
        )
        tracemalloc.start()
        try:
            assert read_image(path).pixels.tobytes() == whole
            assert tracemalloc.get_traced_memory()[1] < 16 << 20
        finally:
            tracemalloc.stop()
    path.write_bytes(path.read_bytes().replace(packed, pack(whole)[:-4].ljust(len(packed), b"\0")))
    with pytest.raises(BenchError, match="damaged or unusual TIFF"):
        read_image(path)


def hollow(path: Path, beginning: bytes, n_bytes: int = 20 << 30) -> Path:
    """Write a file that begins as told and goes on with zeros that take no room on the disk."""
    with path.open("wb") as file:
        file.write(beginning)
        file.truncate(n_bytes)
    return path


def npy_header(*shape: int) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<u2", "fortran_order": False, "shape": shape})
    return file.getvalue()


MATLAB = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x100, b"IM")
STORED = struct.pack("<10I", 6, 8, 6, 0, 5, 8, 31000, 31000, 0x10001, 97) + struct.pack(
    "<II", 4, 2 * 31000**2
)
GIANTS = {
    "a.npy": npy_header(100_000, 100_000),
    "long.npy": b"\x93NUMPY\2\0\xff\xff\xff\xee",
    "a.tif": b"II*\0",
    "a.png": b"\x89PNG\r\n\x1a\n",
    "a.jpg": b"\xff\xd8\xff",
    "a.bmp": b"BM",
    "a.npz": b"PK\3\4",
    "listing.npz": b"PK\3\4",
    "stored.mat": MATLAB + struct.pack("<II", 14, len(STORED) + 2 * 31000**2) + STORED,
    "packed.mat": MATLAB + struct.pack("<II", 15, 4_000_000_000),
}


@pytest.mark.parametrize("name", GIANTS)
def test_a_file_of_gigabytes_with_a_right_beginning_is_refused_unread(tmp_path: Path, name: str) -> None:
    path = hollow(tmp_path / name, GIANTS[name])
    if name == "listing.npz":
        with path.open("ab") as file:
            file.write(struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 1, 1, 4_000_000_000, 0, 0))
    tracemalloc.start()
    try:
        with pytest.raises(BenchError) as caught:
            read_image(path)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value)
    if name.endswith((".npy", ".tif")):
        with pytest.raises(BenchError):
            open_volume(path)


def test_what_follows_an_image_is_not_read(tmp_path: Path) -> None:
    for suffix in (".tif", ".npy"):
        path = tmp_path / f"a{suffix}"
        write_image(path, np.arange(12, dtype=np.uint16).reshape(3, 4))
        with path.open("r+b") as file:
            file.truncate(20 << 30)
        assert read_image(path).pixels.sum() == 66


def test_volumes_of_nothing_and_chunks_of_gigabytes_are_refused(tmp_path: Path) -> None:
    import zarr

    for name, side in (("empty", 44_000), ("large", 10)):
        folder = tmp_path / f"{name}.ome.zarr"
        group = zarr.open_group(folder, mode="w", zarr_format=3)
        group.create_array("0", shape=(1, side, side), dtype="float32", chunks=(1, side, side))
        group.attrs["ome"] = ome_attributes(name, "zyx", {})
    (tmp_path / "large.ome.zarr/0/c/0/0").mkdir(parents=True)
    hollow(tmp_path / "large.ome.zarr/0/c/0/0/0", b"")
    for name, words in (("empty", "made to fill the memory"), ("large", "for numbers of 400 bytes: damaged")):
        for read in (open_volume, read_image):
            with pytest.raises(BenchError, match=words):
                read(tmp_path / f"{name}.ome.zarr")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (".".join(["a"] * 5000) + " = 1", "a key of more than 64 parts"),
        ("[" + " . ".join(['"a"'] * 5000) + "]", "a key of more than 64 parts"),
        ("#\n" * 1_000_000, "TOML has at most 1.57 MB"),
    ],
)
def test_toml_that_would_take_minutes_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    for read in (load_config, load_plan):
        with pytest.raises(BenchError, match=words):
            read(path)


def test_json_of_more_values_than_memory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("[" + "[]," * 2_000_000 + "0]")
    with pytest.raises(BenchError, match="more than 3000000 values"):
        load_plan(path)
    with pytest.raises(BenchError, match="at most 50"):
        load_plan(hollow(tmp_path / "b.json", b"{"))


def test_a_log_of_gigabytes_of_nothing_is_refused(tmp_path: Path) -> None:
    run = READERS["run"].make(tmp_path)
    with (run / "log.jsonl").open("r+b") as file:
        file.truncate(20 << 30)
    with pytest.raises(BenchError, match=r"log.jsonl: says that it holds 21.5 GB"):
        READERS["run"].read(run)


def _film_that_says(folder: Path, shape: list[int]) -> Path:
    film = READERS["video"].make(folder)
    said = json.loads((film / "0/zarr.json").read_text())
    said["shape"] = shape
    said["chunk_grid"]["configuration"]["chunk_shape"] = [1, *shape[1:]]
    (film / "0/zarr.json").write_text(json.dumps(said))
    return film


def test_a_film_that_says_more_than_it_has_is_not_believed(tmp_path: Path) -> None:
    assert len(Film(_film_that_says(tmp_path / "long", [10**12, 12, 16]))) == 2
    large = Film(_film_that_says(tmp_path / "large", [2, 10**5, 10**5]))
    with pytest.raises(BenchError, match=r"says that it holds 40 GB in .* damaged, or made to fill"):
        large.read(0)


def test_a_picture_of_a_film_that_is_a_pipe_or_damaged_is_a_sentence(tmp_path: Path) -> None:
    film = READERS["video"].make(tmp_path)
    picture = film / "0/c/0/0/0"
    picture.write_bytes(b"no zstd")
    with pytest.raises(BenchError, match=r"film.ome.zarr: picture 0 cannot be read"):
        Film(film).read(0)
    picture.unlink()
    os.mkfifo(picture)
    with pytest.raises(BenchError, match="pipe"):
        Film(film).read(0)
    (film / "0/zarr.json").write_text('{"a": ' * 5000)
    with pytest.raises(BenchError, match="is no video of 'reconstruct --video'"):
        Film(film)
