"""How much memory a volume takes, said before it is taken; and where it goes when there is not enough."""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base.threads import get_threads
from recon.camera.convolution import GROUPS
from recon.errors import InputError, NoMemoryError

GIB = 2**30


def in_words(n_bytes: float) -> str:
    """Return an amount of memory: ``"1.50 GiB"``, below a tenth of one ``"3.2 MiB"``."""
    return f"{n_bytes / GIB:.2f} GiB" if n_bytes >= 0.1 * GIB else f"{n_bytes / 2**20:.1f} MiB"


LOW_MODES = 3.4 * 2**20
"""Bytes of the matrices of a preconditioner's lowest modes, of pictures and volumes of any size."""
KEPT_FREE = 0.1
"""Share of the available memory that is left to everybody else."""


@dataclass(frozen=True)
class MemoryPlan:
    """What a reconstruction will take, in bytes.

    Attributes
    ----------
    state : int
        The solver's volumes: what may go to disk.
    traffic : int
        How much of the state an iteration reads and writes: the price of having it on disk.
    work : int
        Planes, PSFs and the result: what must be in memory.
    available : int
        Memory that the machine can give now.
    """

    state: int
    work: int
    available: int
    traffic: int = 0

    @property
    def room(self) -> int:
        """What is left for the state in memory."""
        return max(int((1 - KEPT_FREE) * self.available) - self.work, 0)

    @property
    def total(self) -> int:
        """All of it."""
        return self.state + self.work

    @property
    def fits(self) -> bool:
        """Whether everything fits into memory, with a margin."""
        return self.total <= (1 - KEPT_FREE) * self.available

    def __str__(self) -> str:
        """Say it in words."""
        return (
            f"{in_words(self.total)} ({in_words(self.state)} solver state, {in_words(self.work)} "
            f"PSFs, planes and result) of {in_words(self.available)} available"
        )


def plan(
    kind: str,
    domain_shape: tuple[int, ...],
    psf_values: int,
    result_values: int,
    *,
    itemsize: int = 4,
    available: int | None = None,
) -> MemoryPlan:
    """Work out what a solver will need.

    Parameters
    ----------
    kind : {"tv", "l1"}
        Whose solver: of ``tv`` X, g and four states are kept, of ``l1`` z and the transfer functions.
    domain_shape : tuple of int
        ``(1, n_z, grid_height, grid_width)``: channels are reconstructed one after the other.
    psf_values, result_values : int
        Numbers kept of the PSFs and of the result.
    itemsize : int
        Bytes a number.
    available : int, optional
        Bytes; default what the operating system says.
    """
    _, n_z, height, width = domain_shape
    spectrum = n_z * height * (width // 2 + 1) * 2 * itemsize
    real = n_z * height * width * itemsize
    volumes = 2 * spectrum + 4 * real if kind == "tv" else spectrum + real
    plane = height * (width // 2 + 1) * 2 * itemsize
    groups, result = min(GROUPS, n_z), result_values * itemsize
    if kind == "tv":  # the sweep's scratch, or, when that is over, a copy of the solution and the result
        scratch = (4 + 5 * min(get_threads(), n_z) + 0.6 * groups) * plane
        beside = max(scratch, result + real + 2 * plane) + LOW_MODES
    else:  # the lowest modes take the most before the first iteration, and half of it is kept
        beside = max(result + (9 + 0.5 * groups) * plane + 0.5 * LOW_MODES, 6 * plane + LOW_MODES)
    work = psf_values * itemsize + groups * plane + int(beside)
    # TV: the spectra X (twice read and written) and g (twice read), four states read and written. l1: z read
    # and written, the transfer functions read.
    traffic = 6 * spectrum + 8 * real if kind == "tv" else spectrum + 2 * real
    return MemoryPlan(volumes, work, available_bytes() if available is None else available, traffic)


_VARYING = {"tv": (33.0, 6.5), "l1": (9.0, 6.4)}
"""Volumes, and planes beside them, that splitting through varying PSFs takes at its peak, as NumPy
counts it at one and four planes."""
_SCATTERED = 2.6
"""Planes for every PSF whose weights are interpolated between scattered places, while its camera is made."""


def varying_bytes(kind: str, n_z: int, plane: int, camera: int, scattered: int) -> int:
    """Return what solving through varying PSFs takes.

    ``plane`` bytes a plane, ``camera`` its operator's; ``scattered`` PSFs at most of a depth lie on no grid.
    """
    volumes, planes = _VARYING["tv" if kind == "tv" else "l1"]
    return int(max((volumes * n_z + planes) * plane + camera, _SCATTERED * scattered * plane))


_PICTURE = (13.0, 2.3, 12.8)
"""Grids a channel, grids beside them, and sensors a channel that a picture's splitting takes at its peak."""


def picture_bytes(channels: int, grid: int, sensor: int) -> int:
    """Return what a picture through one PSF takes, its first look included; bytes a grid and a sensor."""
    per_channel, beside, per_sensor = _PICTURE
    return int((per_channel * channels + beside) * grid + per_sensor * channels * sensor + LOW_MODES)


def available_bytes() -> int:
    """Memory that this process may still take: what is free, within its control group's limit."""
    free = []
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        for line in meminfo.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    group = Path("/sys/fs/cgroup")
    limit, used = group / "memory.max", group / "memory.current"
    if limit.exists() and used.exists() and limit.read_text().strip().isdigit():
        free.append(int(limit.read_text()) - int(used.read_text()))
    return min(free, default=2**62)


class MemoryMeter:
    """Measures the most memory that this process took at a time since the meter was made, in MiB.

    NaN where the system does not say (it is Linux that does).
    """

    def __init__(self) -> None:
        self._before = _reset_peak_mib()
        self._most = 0.0

    def peak_mib(self) -> float:
        """Return the most so far beyond what was taken at the start, without what was taken aside."""
        now = _status_mib("VmHWM") - self._before
        return now if now != now else max(self._most, now)  # NaN has to stay one

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Do something whose memory does not count, nor what it leaves behind."""
        self._most = self.peak_mib()
        present = _status_mib("VmRSS")
        try:
            yield
        finally:
            self._before += _reset_peak_mib() - present


def give_back() -> None:
    """Have the C library give memory that was freed back to the system; where it cannot, nothing happens."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def resident_bytes() -> float:
    """Return the memory that this process takes now; NaN where the system does not say."""
    return _status_mib("VmRSS") * 2**20


def peak_resident_bytes() -> float:
    """Return the most memory that this process took since its meter was set; NaN as above."""
    return _status_mib("VmHWM") * 2**20


def _reset_peak_mib() -> float:
    """Forget the highest memory so far; return what is taken now, MiB (NaN where the system does not say)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return float("nan")
    return _status_mib("VmHWM")


def _status_mib(name: str) -> float:
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    for line in status.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) / 1024
    return float("nan")


_PREFIX = ".diffuserbench-scratch-"


def _scratch_folder(place: Path) -> tuple[Path, int]:
    """Make a folder for volumes, locked by the handle that is returned; remove what killed programs left."""
    for left in place.glob(f"{_PREFIX}*"):
        with suppress(OSError):
            handle = os.open(left, _FOLDER)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(left)
            finally:
                os.close(handle)
    made = Path(tempfile.mkdtemp(prefix=_UNLOCKED, dir=place))
    handle = os.open(made, _FOLDER)
    with suppress(OSError):  # disks that have no locks do without
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    folder = made.with_name(_PREFIX + made.name.removeprefix(_UNLOCKED))
    return made.rename(folder), handle


_UNLOCKED = ".diffuserbench-new-"
"""What has no lock yet has a name that nobody looks for."""
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def _give_up(folder: Path, handle: int) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    os.close(handle)


class Storage:
    """Where a solver's volumes live: in memory, or as files in a scratch folder that the system pages.

    Solvers pass over their volumes plane by plane, so that files are read and written in runs of whole depth
    planes, and at any time only the planes in work need memory.

    Parameters
    ----------
    scratch : path, optional
        Folder for the files (a fast disk); :meth:`close` removes them. Default: memory.
    room : int
        Bytes that may lie in memory all the same: the first volumes that fit.
    """

    def __init__(self, scratch: Path | str | None = None, room: int = 0) -> None:
        self._room = room
        self.on_disk = 0
        self._turn: list[tuple[int, Path | None]] = []
        """Bytes and files (None: in memory) taken since the last turn."""
        self._folder: Path | None = None
        if scratch is not None:
            self._folder, held = _scratch_folder(Path(scratch))
            self._remove = weakref.finalize(self, _give_up, self._folder, held)
        self._count = 0

    def close(self) -> None:
        """Remove the files. Arrays in them must not be used any more."""
        if self._folder is not None:
            self._remove()

    def turn(self) -> Callable[[], None]:
        """Begin another turn; the function that is returned gives up the arrays of those before."""
        before, self._turn = self._turn, []

        def give_up() -> None:
            for size, path in before:
                if path is None:
                    self._room += size
                else:
                    self.on_disk -= size
                    path.unlink(missing_ok=True)

        return give_up

    def zeros(self, shape: tuple[int, ...], dtype: npt.DTypeLike, *, lasting: bool = False) -> Array:
        """Return an array of zeros; a lasting one outlives its :meth:`turn`.

        Raises InputError when the scratch folder's disk has no room for it.
        """
        size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if self._folder is None or size <= self._room:
            self._room -= size
            self._turn += [] if lasting else [(size, None)]
            return np.zeros(shape, dtype)
        free = shutil.disk_usage(self._folder).free
        if size > free:
            raise InputError(
                f"The scratch folder {self._folder.parent} has {in_words(free)} free; "
                f"{in_words(size)} more are needed. Name a folder on another disk."
            )
        self._count += 1
        self.on_disk += size
        path = self._folder / f"{self._count}.dat"
        self._turn += [] if lasting else [(size, path)]
        array = np.memmap(path, dtype=dtype, mode="w+", shape=shape).view(np.ndarray)
        if hasattr(
            os, "posix_fallocate"
        ):  # a file without its blocks kills the process when the disk is full
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, size)
        return array


def scratch_for(plan: MemoryPlan, scratch: Path | str | None) -> Path | str:
    """Return the scratch folder for a plan that does not fit into memory.

    Raises NoMemoryError when there is none, or not even the part that must be in memory fits.
    """
    if plan.work > (1 - KEPT_FREE) * plan.available:
        raise NoMemoryError(f"This volume needs {plan}. Bin the images or take fewer depths.")
    if scratch is None:
        raise NoMemoryError(
            f"This volume needs {plan}. Bin the images, take fewer depths, use the l1 prior (two volumes "
            "instead of six), or name a scratch folder (--scratch) on a fast disk for the solver's state; "
            f"an iteration then reads and writes {in_words(plan.traffic)} there at most."
        )
    if lies_in_memory(Path(scratch)):
        raise InputError(f"The scratch folder {scratch} lies in memory itself (tmpfs). Name one on a disk.")
    return scratch


def lies_in_memory(folder: Path) -> bool:
    """Tell whether a folder's file system is kept in memory."""
    mounts = Path("/proc/mounts")
    if not mounts.exists():
        return False
    place = folder.resolve()
    found = ("", "")
    for line in mounts.read_text().splitlines():
        _, mount, kind, *_ = line.split()
        if place.is_relative_to(mount) and len(mount) >= len(found[0]):
            found = (mount, kind)
    return found[1] in ("tmpfs", "ramfs")
