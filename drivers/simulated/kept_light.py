"""Light of a scene on a large sensor, kept on disk from one start of the program to the next.

It is found by all that it was computed from, the program's own text included, so that what is found is to the
last bit what would be computed. Files are checked as they are read; a folder that cannot be written to or a
damaged file means that light is computed, as ever.
"""

from __future__ import annotations

import hashlib
import os
import platform
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

import recon.optics
from drivers.common.cache import cache_folder
from recon.arrays import Float32Array, Float64Array
from recon.optics.scene import Scene

WORTH_PIXELS = 1_000_000
"""Light on fewer is computed in less than a second."""
MOST_BYTES = 256 << 20
"""On disk; beyond, what was used longest ago is removed."""
_COMPUTED_BY = ("numpy", "scipy", "numba", "rocket-fft", "opencv-python-headless")


def place() -> Path:
    """Return the folder; it may be removed at any time."""
    return cache_folder() / "light"


def name_of(scene: Scene, *circumstances: object) -> str:
    """Return the name that a scene's light is kept by; ``circumstances`` tell all else by their ``repr``."""
    digest = hashlib.blake2b(repr((_program(), circumstances)).encode(), digest_size=20)
    for array, rest in _content(scene):
        digest.update(repr((array.shape, rest)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _content(scene: Scene) -> Iterator[tuple[Float32Array | Float64Array, object]]:
    for layer in scene.layers:
        yield layer.radiance, (layer.z_um, layer.size_um, layer.center_um)
    for beads in scene.beads:
        yield beads.positions_um, beads.diameter_um
        yield beads.powers, None


@cache
def _program() -> str:
    """Return a digest of the program's own text that light goes by, and what it is computed with and on."""
    digest = hashlib.blake2b(platform.node().encode())  # processors differ in the last bit
    for name in _COMPUTED_BY:
        with suppress(PackageNotFoundError):
            digest.update(f"{name} {version(name)}".encode())
    optics = Path(recon.optics.__file__).parent
    here = Path(__file__).parent
    files = [*optics.glob("*.py"), *optics.with_name("base").glob("*.py"), *here.glob("*.py")]
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def is_kept(name: str) -> bool:
    """Whether there is light by this name."""
    return _file(name).exists()


def kept(name: str) -> Float32Array | None:
    """Return the light that was kept by a name."""
    path = _file(name)
    with suppress(OSError, ValueError, KeyError, zipfile.BadZipFile):
        with path.open("rb") as file, np.load(file) as found:  # its checksum is looked at
            light = found["light"]
        os.utime(path)
        return np.asarray(light, np.float32)
    return None


def keep(name: str, light: Float32Array) -> None:
    """Keep light by a name, where there is room and a folder that may be written to."""
    path = _file(name)
    part = path.with_suffix(f".{os.getpid()}.part")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as file:
                np.savez(file, light=light)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        _make_room()


def _make_room() -> None:
    files = {path: path.stat() for path in place().iterdir()}
    newest_first = sorted(files, key=lambda path: files[path].st_mtime, reverse=True)
    total = 0
    for path in newest_first:
        total += files[path].st_size
        if total > MOST_BYTES:
            path.unlink(missing_ok=True)


def _file(name: str) -> Path:
    return place() / f"{name}.npz"
