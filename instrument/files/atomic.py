"""Files and folders written whole or not at all: under a temporary name beside the target, synced, moved.

While it is written, what has a temporary name is locked: what a killed program left has no lock, and is
removed when the next program writes into its folder. What a disk has free is looked up here, too.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from instrument.files.errors import FileError

SPARE_BYTES = 256 * 2**20
"""Disk space that a run leaves free."""
_NEARLY_FULL_BYTES = 1 << 20
_LEFT = re.compile(r"\..+\.[0-9a-f]{8}\.part(\.[^.]+)?")
_EXCHANGE, _HERE = 2, -100
"""``RENAME_EXCHANGE`` and ``AT_FDCWD`` of Linux."""
_cleared: set[Path] = set()
_inputs: ContextVar[tuple[Path, ...] | None] = ContextVar("inputs", default=None)
"""What the work at hand reads; None where no work was begun."""


@contextlib.contextmanager
def protecting(inputs: Iterable[Path]) -> Iterator[None]:
    """Refuse, in this thread and while the block runs, to write over any of ``inputs``."""
    before = _inputs.set(_inputs.get() or ())
    try:
        protect(*inputs)
        yield
    finally:
        _inputs.reset(before)


def protect(*inputs: Path) -> None:
    """Add what an input names in its turn (a bench's mask, a plan's images) to the work's inputs.

    Of an array of a file (``FILE::NAME``) the file. Nothing where no work was begun: what is read is then
    nobody's input.
    """
    if (before := _inputs.get()) is not None:
        files = (path if path.exists() else Path(str(path).partition("::")[0]) for path in inputs)
        _inputs.set((*before, *(path for path in files if path.exists())))


def refuse_input(path: Path) -> None:
    """Refuse to write over an input of the work at hand, whatever name or link leads to it.

    Inputs are what :func:`protecting` holds: files, and folders with the files in them and what links in them
    lead to. A run or a calibration, which get results beside what they hold, are held as a whole only.

    Raises FileError.
    """
    inputs = _inputs.get() or () if is_same(path, path) else ()  # what is not there is none
    for held in (place for one in inputs for place in (one, *_linked(one))):
        if is_same(path, held):
            found = "is an input itself"
        elif path.is_dir() and is_within(held, path):
            found = f"holds the input {held}"
        elif is_content(held) and is_within(path, held):
            found = f"is part of the input {held}"
        else:
            continue
        raise FileError(
            path, f"{found}; no output replaces an input, by --force neither.", "Choose another name."
        )


def _linked(folder: Path) -> Iterator[Path]:
    """Give what links in a folder that is read lead to, and links in the folders that these lead to."""
    left, seen = [folder], set[str]()
    while left:
        place, found = os.path.realpath(left.pop()), list[os.DirEntry[str]]()
        with contextlib.suppress(PermissionError):  # nor can it be read
            if place not in seen and is_content(Path(place)):
                with os.scandir(place) as entries:  # 10^5 names take no Paths
                    found += (entry for entry in entries if entry.is_symlink() or entry.is_dir())
        seen.add(place)
        left += (Path(entry) for entry in found)
        yield from (Path(entry).resolve() for entry in found if entry.is_symlink() and Path(entry).exists())


def is_within(path: Path, folder: Path) -> bool:
    """Whether a path is in a folder or below, as the disk knows it: by another case or mount, too."""
    return any(is_same(place, folder) for place in path.resolve().parents)


def is_same(one: Path, other: Path) -> bool:
    """Whether two names, links followed, are of one file or folder that is there."""
    try:
        return one.samefile(other)
    except OSError:
        return False


def is_content(folder: Path) -> bool:
    """Whether everything in a folder is what it is read for."""
    return folder.is_dir() and not any((folder / own).exists() for own in ("state.json", "calibration.json"))


DOUBTFUL = "doubtful_"
"""Before the name of a result that is not to be relied on."""


def named_by_worth(path: Path, *, doubted: bool, overwrite: bool = True) -> Path:
    """Return where a result goes that was to go to ``path``: a doubted one never under a good one's name.

    Without ``overwrite`` a number is put behind a doubtful name that is taken.
    """
    if not doubted:
        return path
    named, number = path.with_name(DOUBTFUL + path.name), 1
    while named.exists() and not overwrite:
        number += 1
        named = path.with_name(f"{DOUBTFUL}{path.stem}-{number}{path.suffix}")
    return named


@contextlib.contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Give a temporary path beside ``path``; what is written there takes its place when the block ends.

    When the block raises, the temporary file is removed and ``path`` stays as it was. The temporary name
    keeps the suffix, so that writers which choose the format by it do the same.

    Raises FileError when the folder is missing or cannot be written to; OSError when writing fails (a full
    disk), naming ``path``.
    """
    path = Path(path)
    check_writable(path)
    temporary = _draft_name(path, path.stem, path.suffix)
    try:
        with contextlib.ExitStack() as after:
            held = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
            after.callback(os.close, held)
            _hold(held)
            yield temporary
            with temporary.open("rb") as written:
                os.fsync(written.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
    except OSError as error:
        if error.errno is None and shutil.disk_usage(path.parent).free < _NEARLY_FULL_BYTES:
            # Some writers only notice that less was written than they asked for.
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


@contextlib.contextmanager
def draft_folder(path: Path, *, locked: bool = True) -> Iterator[Path]:
    """Give a new folder beside ``path``, under a temporary name; it is removed where it still has that name.

    ``locked``: False for a caller that locks it itself, at once.

    Raises OSError when it cannot be made.
    """
    draft = _draft_name(path, path.name)
    draft.mkdir()
    held = os.open(draft, os.O_RDONLY)
    try:
        if locked:
            _hold(held)
        yield draft
    finally:
        os.close(held)
        shutil.rmtree(draft, ignore_errors=True)


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a new folder beside ``path``; it takes its place, synced, when the block ends.

    A folder that was there is removed once the new one stands. When the block raises, the new one is removed
    and ``path`` stays as it was.

    Raises OSError when writing fails.
    """
    refuse_input(path)
    with draft_folder(path) as draft:
        yield draft
        for place, _, files in os.walk(draft):
            for name in files:
                with (Path(place) / name).open("rb") as written:
                    os.fsync(written.fileno())
            sync_folder(Path(place))
        if not (path.exists() and _exchanged(draft, path)):
            old = path.with_name(f".{path.name}.{secrets.token_hex(4)}.old")
            if path.exists():
                path.rename(old)
            try:
                draft.rename(path)
            except OSError:
                if old.exists():
                    old.rename(path)
                raise
            shutil.rmtree(old, ignore_errors=True)
        sync_folder(path.parent)


def _draft_name(path: Path, stem: str, suffix: str = "") -> Path:
    """Return a temporary name beside ``path``, in a folder cleared of what was left there."""
    clear_left(path.parent)
    return path.with_name(f".{stem}.{secrets.token_hex(4)}.part{suffix}")


def _hold(handle: int) -> None:
    """Lock a draft as long as it is open; disks that have no locks do without."""
    with contextlib.suppress(OSError):
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _exchanged(one: Path, other: Path) -> bool:
    """Exchange two names in one step, so that neither is ever missing; whether system and disk can."""
    import ctypes

    try:
        rename = ctypes.CDLL(None).renameat2
    except AttributeError:
        return False
    return bool(rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0)


def clear_left(folder: Path, *, again: bool = False) -> None:
    """Remove what a killed program left of what it was writing in a folder, once a process, or ``again``.

    What another program writes now is locked, and stays.
    """
    if (place := folder.absolute()) in _cleared and not again:
        return
    _cleared.add(place)
    with contextlib.suppress(OSError):
        for name in filter(_LEFT.fullmatch, os.listdir(place)):  # noqa: PTH208 # 10^5 names take no Paths
            with contextlib.suppress(OSError):
                handle = os.open(place / name, os.O_RDONLY | os.O_NOFOLLOW)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if (place / name).is_dir():
                        shutil.rmtree(place / name)
                    else:
                        (place / name).unlink()
                finally:
                    os.close(handle)


def require_new(path: Path, *, overwrite: bool | None = None) -> None:
    """Refuse to write over what exists, unless it may be overwritten; None: no option would allow it.

    Raises FileError.
    """
    refuse_input(path)
    if path.exists() and not overwrite:
        remedy = "" if overwrite is None else "Choose another name, or overwrite with --force."
        raise FileError(path, "exists already and was left as it is.", remedy)


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text; errors as ``whole_file``."""
    write_bytes(path, text.encode())


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write bytes; errors as ``whole_file``."""
    with whole_file(path) as temporary:
        temporary.write_bytes(data)


def make_folder(path: Path) -> None:
    """Make a folder that does not exist yet, and put its name on the disk."""
    path.mkdir()
    sync_folder(path.parent)


def output_folder(folder: Path) -> None:
    """Make a folder for results, and those above it, where it is not there.

    Raises FileError when a file has its name.
    """
    if folder.exists() and not folder.is_dir():
        raise FileError(folder, "is a file; a folder is expected.", "Name another with --out.")
    folder.mkdir(parents=True, exist_ok=True)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a mapping as a JSON file, atomically."""
    write_bytes(path, json_text(data).encode())


def json_text(data: Mapping[str, Any]) -> str:
    """Return a mapping as the text of a JSON file."""
    return json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def check_writable(path: Path | str, n_bytes: int = 0) -> None:
    """Refuse a file that could not be written, before the work that would fill it.

    The disk must have room for ``n_bytes``.

    Raises FileError.
    """
    path = Path(path)
    folder = path.parent
    refuse_input(path)
    if path.is_dir():
        raise FileError(path, "is a folder; a file name is expected.")
    if path.exists() and not path.is_file():
        raise FileError(path, "is a device or pipe, which a file would take the place of.", "Name a file.")
    if not folder.is_dir():
        found = "is no folder" if folder.exists() else "does not exist"
        raise FileError(path, f"its folder {folder} {found}.", "Make it first.")
    disk = os.statvfs(folder)
    if disk.f_flag & os.ST_RDONLY:
        raise FileError(path, f"{folder} is on a read-only disk.", "Choose another place.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise FileError(path, f"no permission to write in {folder.absolute()}.", "Choose another place.")
    if disk.f_blocks == 0 and folder.resolve().is_relative_to("/proc"):
        raise FileError(
            path, f"{folder} is the system's own and holds no files of ours.", "Choose another place."
        )
    free = disk.f_bavail * disk.f_frsize
    if free < n_bytes:
        raise FileError(
            path,
            f"needs {n_bytes / 1e6:.1f} MB, and {free / 1e6:.1f} MB are free on its disk.",
            "Free some, or choose another place.",
        )


def sync_folder(folder: Path) -> None:
    """Put a folder's entries on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def free_bytes(folder: Path) -> int:
    """Return the free space of the disk that ``folder`` is or will be on.

    Raises FileError when nothing can be kept there: its path leads to no disk or through a file, or may not
    be written to.
    """
    there = there_now(folder)
    if not there.is_dir():
        raise FileError(folder, f"{there} is a file, not a folder; nothing can be kept there.")
    if os.statvfs(there).f_flag & os.ST_RDONLY:
        raise FileError(folder, f"{there} is on a read-only disk; nothing can be kept there.")
    if not os.access(there, os.W_OK):
        raise FileError(folder, f"you may not write to {there}; nothing can be kept there.")
    return shutil.disk_usage(there).free


def there_now(folder: Path) -> Path:
    """Return what there is of a path already: itself, or the nearest folder above it.

    Raises FileError when there is nothing of it, not even its disk.
    """
    path = folder.absolute()
    for there in (path, *path.parents):
        if there.exists():
            return there
    raise FileError(folder, "nothing of this path is there, not even its disk. Is the drive connected?")
