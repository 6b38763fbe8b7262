"""A reconstruction that is kept in a folder while it runs, and gone on with.

``problem.json`` says what is being reconstructed, one ``.npz`` file a part holds a solver's state and
history. Each is written whole or not at all; a kill costs what came after the last.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.atomic import (
    check_writable,
    clear_left,
    is_within,
    refuse_input,
    whole_file,
    write_json,
)
from instrument.files.errors import BenchError, FileError, os_reason
from instrument.files.reading import parse_json, read_bytes
from instrument.files.record import plain
from instrument.reconstruction.job import Job
from instrument.reconstruction.patterned import PatternedRequest
from instrument.reconstruction.request import PictureRequest, VolumeRequest
from recon.arrays import Array, Float64Array
from recon.base.declare import identity
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import IterationRecord, Solver, StopReason

_FINISHED = (StopReason.CONVERGED, StopReason.NOISE_LEVEL)


def require_kept(
    folder: Path | None,
    request: PictureRequest | VolumeRequest | PatternedRequest,
    outputs: Sequence[Path] = (),
) -> None:
    """Refuse to keep what has no iterations, a folder of something else, and ``outputs`` in it.

    Raises BenchError; FileError.
    """
    if folder is None:
        return
    if folder.is_dir():
        _refuse_others(folder)
    for output in outputs:
        if is_within(output, folder):
            raise FileError(
                output,
                f"lies in the checkpoint {folder}, which is removed in the end.",
                "Name another folder.",
            )
        if is_within(folder, output):
            raise FileError(folder, f"lies in {output}, which is replaced by the result.", "Name another.")
    solver = request.options.solver
    if solver != "auto" and SOLVERS.named(solver).one_step:
        raise BenchError(f"{solver} is one shot: --checkpoint does not apply to it.")


def checkpoint_for(
    folder: Path | None,
    job: Job,
    request: PictureRequest | VolumeRequest | PatternedRequest,
    patterned: Measurement | None = None,
    *,
    say: Callable[[str], None] = lambda _: None,
) -> CheckpointFolder | None:
    """Return the folder that was asked for, checked against what is to be reconstructed.

    ``patterned``: all frames under their patterns, of which the job has the sum. What only says when to stop
    may differ from the earlier run. ``say`` is told once, at once, that nothing can be kept any more.

    Raises BenchError as :func:`require_kept`; FileError when the folder keeps something else.
    """
    if folder is None:
        return None
    require_kept(folder, request)
    problem = {
        "program": f"diffuserbench {version('diffuserbench')}",
        "format": FORMAT,
        "measurement": digest(job.measurement),
        "psfs": digest(job.calibration.psfs),
        "psf positions": digest(job.calibration.source_positions_um),
        "valid pixels": digest(job.valid),
        **identity(request.options),
        # As it will be used: the photograph's metadata may have told it.
        "noise": str(job.binned_noise(request.inputs.noise)),
    }
    if patterned is not None:
        problem |= {
            "measurement": digest(np.asarray(patterned.image)),
            "valid pixels": digest(None if patterned.erasures is None else np.asarray(patterned.erasures)),
            "patterns": digest(np.asarray(patterned.patterns)),
        }
    return CheckpointFolder(folder, problem, say=say)


def settle_checkpoint(
    keeper: CheckpointFolder | None, reasons: Sequence[StopReason | None]
) -> dict[str, str]:
    """Remove a checkpoint whose work has come to its end; return what is to be told of it, by headings.

    To be called once the result is written: until then the checkpoint is all that there is of it.
    """
    told: dict[str, str] = {}
    if keeper is None:
        return told
    if keeper.resumed_from:
        told["Went on"] = f"from iteration {keeper.resumed_from} in {keeper.folder}"
    if keeper.left_aside:
        told["Begun anew"] = (
            f"{', '.join(keeper.left_aside)} in {keeper.folder} is of an older version, or of another "
            "choice of auto, and was not gone on with"
        )
    if all(reason in _FINISHED for reason in reasons):
        others = keeper.remove()
        stays = f"; {keeper.folder} stays, for what else it holds: {', '.join(others)}" if others else ""
        told["Checkpoint"] = f"removed: the work has come to its end{stays}"
    elif keeper.failed:
        told["Checkpoint"] = keeper.failed
    else:
        told["Checkpoint"] = f"{keeper.folder}: the same again, with more time, goes on from it"
    return told


PROBLEM = "problem.json"
FORMAT = 2
"""Of solvers' states: another one's are refused, as those kept before there was a number."""
_HISTORY, _STATE = "history", "state/"
EVERY_S = 60.0
"""Seconds between two writings: the most that a kill costs, and rare enough to cost little itself."""


class CheckpointFolder:
    """A :class:`recon.solvers.base.Keeper` in a folder.

    Raises FileError when the folder holds something else, or cannot be written to.

    Parameters
    ----------
    folder : Path
        Made when missing; an empty one is taken.
    problem : mapping
        What decides the result, JSON-compatible: a folder kept for something else is refused.
    every_s : float
        Least time between two writings of a part.
    say : callable, optional
        Told why nothing can be kept any more, once; the work goes on.

    Attributes
    ----------
    failed : str
        Why nothing was kept when it was last tried; empty where it was.
    left_aside : tuple of str
        Files of work that is not gone on with: of an older version, or of another choice of ``auto``.
    """

    def __init__(
        self,
        folder: Path,
        problem: Mapping[str, Any],
        *,
        every_s: float = EVERY_S,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.folder = folder
        self.failed = ""
        self._every_s, self._say, self._is_said = every_s, say, False
        self._written = time.monotonic()
        self._resumed: dict[str, int] = {}
        self._kept: set[str] = set()
        """Parts whose state is there, of this run or of the one that it goes on from."""
        self.left_aside: tuple[str, ...] = ()
        problem = plain(dict(problem))
        if folder.exists() and not folder.is_dir():
            raise FileError(
                folder, "is a file; a checkpoint is a folder.", "Name another, or one to be made."
            )
        if folder.is_dir():
            _refuse_others(folder)
            refuse_input(folder)
        else:
            check_writable(folder)
            folder.mkdir()
        if (folder / PROBLEM).is_file():
            self._compare(problem)
        else:
            write_json(folder / PROBLEM, problem)

    @property
    def resumed_from(self) -> int:
        """Iterations that earlier runs have done, of the part that is furthest."""
        return max(self._resumed.values(), default=0)

    def resume(self, part: str, solver: Solver) -> tuple[IterationRecord, ...]:
        """Restore what was kept of a part, if anything, and return its history so far."""
        path = self._path(part)
        if not path.is_file():
            if not self._kept:
                self.left_aside = tuple(sorted(other.name for other in self.folder.glob("*.npz")))
            return ()
        try:
            with np.load(path, allow_pickle=False) as kept:
                records = tuple(_record(row) for row in kept[_HISTORY])
                solver.restore(_state(kept))
        except KeyError as error:
            raise FileError(
                path,
                f"was kept by another version of the program, or of another solver: it has no {error}.",
                f"Delete {self.folder} to start over.",
            ) from None
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise FileError(
                path, f"cannot be read as a checkpoint ({error}).", "Delete it to start over."
            ) from None
        self._resumed[part] = len(records)
        self._kept.add(part)
        return records

    def keep(self, part: str, solver: Solver, history: Sequence[IterationRecord], *, ended: bool) -> None:
        """Write a solver's state when it is time to, or its run has ended.

        Where that fails the work goes on: a result is not lost because it cannot be kept on its way.
        """
        if not ended and time.monotonic() - self._written < self._every_s:
            return
        if not history:
            return
        state: dict[str, Any] = {
            f"{_STATE}{name}": value for name, value in _flat(solver.checkpoint(copy=False)).items()
        }
        state[_HISTORY] = np.array([astuple(record) for record in history])
        try:
            if not (self.folder / PROBLEM).is_file():  # states alone would be taken for any problem's
                raise FileError(self.folder, "was deleted or moved meanwhile.")
            with whole_file(self._path(part)) as temporary:
                np.savez(temporary, **state)
        except (OSError, FileError) as error:
            self._cannot_keep(error)
        else:
            self._kept.add(part)
            self.failed = ""
        finally:
            self._written = time.monotonic()

    def _cannot_keep(self, error: OSError | FileError) -> None:
        reason = str(error) if isinstance(error, FileError) else f"{self.folder}: {os_reason(error)}"
        stays = (self.folder / PROBLEM).is_file() and any(self._path(part).is_file() for part in self._kept)
        left = "what was kept before stays, and the same again goes on from there." if stays else ""
        self.failed = f"not kept: {reason} {left.capitalize()}".rstrip()
        if not self._is_said:
            self._is_said = True
            nothing = "what it has done is not kept for another time."
            self._say(f"Warning: {reason} The work goes on; {left or nothing}")

    def remove(self) -> tuple[str, ...]:
        """Delete what was kept, as there is nothing left to go on with; return what else the folder holds.

        The folder goes where it holds nothing else.
        """
        if not self.folder.is_dir():  # somebody did it
            return ()
        clear_left(self.folder, again=True)
        for path in (*filter(_is_state, self.folder.glob("*.npz")), self.folder / PROBLEM):
            path.unlink(missing_ok=True)
        if others := tuple(sorted(path.name for path in self.folder.iterdir())):
            return others
        with contextlib.suppress(OSError):  # a link to it, or a folder that is not ours to take away
            self.folder.rmdir()
        return ()

    def _path(self, part: str) -> Path:
        return self.folder / f"{part or 'picture'}.npz"

    def _compare(self, problem: Mapping[str, Any]) -> None:
        path = self.folder / PROBLEM
        try:
            kept = parse_json(read_bytes(path))
        except (OSError, ValueError) as error:
            raise FileError(path, f"cannot be read ({error}).", "Name another folder.") from None
        if not isinstance(kept, dict) or kept.get("format") != problem.get("format"):
            raise FileError(
                self.folder,
                "was kept by another version of the program, which this one cannot go on from.",
                "Name another folder, or delete this one to start over.",
            )
        for name in sorted({*problem, *kept}):
            if problem.get(name) != kept.get(name):
                raise FileError(
                    self.folder,
                    f"keeps another reconstruction: its {name} is {kept.get(name)!r}, "
                    f"here it is {problem.get(name)!r}.",
                    "Name another folder, or delete this one to start over.",
                )


def _refuse_others(folder: Path) -> None:
    """Refuse a folder that holds something and no checkpoint."""
    clear_left(folder)
    if not (folder / PROBLEM).is_file() and any(folder.iterdir()):
        raise FileError(folder, "holds something else and was left as it is.", "Name another folder.")


def _is_state(path: Path) -> bool:
    """Whether a file is what :meth:`CheckpointFolder.keep` writes."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
    return f"{_HISTORY}.npy" in names and any(name.startswith(_STATE) for name in names)


def digest(array: Array | None) -> str | None:
    """Return what tells an array from others: shape, and the beginning of its SHA-256."""
    if array is None:
        return None
    text = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]
    return f"{' x '.join(map(str, array.shape))} {array.dtype}, {text}"


def _record(row: Float64Array) -> IterationRecord:
    values = dict(zip((f.name for f in fields(IterationRecord)), row.tolist(), strict=True))
    return IterationRecord(**values | {"iteration": int(values["iteration"])})


def _flat(state: Mapping[str, Any] | Sequence[Any], prefix: str = "") -> dict[str, Any]:
    """Name every array and number of a nested state by its path; a list's entries by their index."""
    items = state.items() if isinstance(state, Mapping) else ((f"#{i}", v) for i, v in enumerate(state))
    flat: dict[str, Any] = {}
    for name, value in items:
        if isinstance(value, Mapping | list):
            flat |= _flat(value, f"{prefix}{name}/")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


class _Lazy(dict[str, Any]):
    """A state whose arrays are read one at a time, as the solver takes them: volumes may be large."""

    def __init__(self, kept: Any) -> None:
        super().__init__()
        self._kept = kept

    def __missing__(self, name: str) -> Any:
        if (stored := f"{_STATE}{name}") not in self._kept.files:
            raise KeyError(name)
        return _value(self._kept[stored])


def _state(kept: Any) -> dict[str, Any]:
    names = [name.removeprefix(_STATE) for name in kept.files if name.startswith(_STATE)]
    if not any("/" in name for name in names):
        return _Lazy(kept)
    nested: dict[str, Any] = _nested({name: kept[f"{_STATE}{name}"] for name in names})
    return nested


def _value(array: Array) -> Any:
    return array.item() if array.ndim == 0 else array


def _nested(flat: Mapping[str, Array]) -> Any:
    """Undo :func:`_flat`; arrays of no dimension become numbers again."""
    tree: dict[str, Any] = {}
    for path, value in flat.items():
        *branches, leaf = path.split("/")
        place = tree
        for branch in branches:
            place = place.setdefault(branch, {})
        place[leaf] = _value(value)
    return _lists(tree)


def _lists(tree: Any) -> Any:
    if not isinstance(tree, dict):
        return tree
    if tree and all(name.startswith("#") for name in tree):
        return [_lists(tree[f"#{i}"]) for i in range(len(tree))]
    return {name: _lists(value) for name, value in tree.items()}
