"""The small files of a run, and their copies in its log, by which a damaged one is noticed and made again."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from instrument.files.atomic import is_same
from instrument.files.calibration_file import CALIBRATION_FILES, is_calibration
from instrument.files.errors import FileError
from instrument.files.reading import parse_json, read_bytes
from instrument.files.record import RecordFormat

PLAN, BENCH, PROVENANCE, STATE = "plan.json", "bench.json", "provenance.json", "state.json"
BENCH_TOML, LOG, FRAMES, LOCK = "bench.toml", "log.jsonl", "frames.ome.zarr", "lock"
SLM_IMAGES, KEPT, DAMAGED = "slm", "kept", "damaged.json"
UNCHANGING = (PLAN, BENCH, BENCH_TOML, PROVENANCE)
"""Files that are as they were written; a routine's own record may be put right by hand."""


MADE_AGAIN = "makes its files again"
_LONGEST_COPY = 30 << 20
"""Bytes of a text that the log takes a copy of: escaped as JSON, it stays below a line's limit."""


class RunError(FileError):
    """A run folder that cannot be used as asked."""


RUN_STATE = RecordFormat("diffuserbench run", "run's state", error=RunError, numbered_before=True)
"""``state.json``; its version is that of the whole folder."""

NOTED = RecordFormat("diffuserbench damaged frames", "note of damaged frames", error=RunError)
"""``damaged.json``: what reading a run found damaged, for who looks at sizes only."""


@dataclass(frozen=True, slots=True)
class FileProblem:
    """A file of a run that is not as it was written."""

    name: str
    problem: str
    text: str | None = None
    """What it should hold; None where that is not known."""
    remedy: str = ""
    """What ``resume`` does about it; empty where it can do nothing."""
    of: str = ""
    """The result that it is part of, as it is named in the run's folder; empty for the run's own files."""

    def __str__(self) -> str:
        return f"{self.name}: {self.problem}"


def copies_of(texts: Mapping[str, str]) -> list[dict[str, str]]:
    """Return the lines of the log that keep these files' texts, by name; a text too long gets none."""
    short = {name: text for name, text in texts.items() if len(text.encode()) <= _LONGEST_COPY}
    return [{"kind": "file", "name": name, "text": text} for name, text in short.items()]


def slm_image_name(data: bytes, suffix: str) -> str:
    """Return the name of a run's copy of an SLM image: its content's."""
    return f"{sha256(data).hexdigest()[:16]}{suffix}"


@dataclass
class RunFiles:
    """The small files of the run in ``path``; ``copies``: their texts by name, as the log has them."""

    path: Path
    copies: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of_log(cls, path: Path, events: Iterable[Mapping[str, Any]]) -> RunFiles:
        """Take the copies from a log's events; the last of a name counts."""
        copies = {str(e["name"]): str(e["text"]) for e in events if e.get("kind") == "file"}
        return cls(path, copies)

    def text(self, name: str) -> str | None:
        """Return what a file held when it was written, or else what it holds; None where there is none."""
        if name in self.copies and name in UNCHANGING:
            return self.copies[name]
        try:
            return read_bytes(self.path / name, error=RunError).decode()
        except FileNotFoundError:
            return None
        except UnicodeDecodeError:
            raise RunError(self.path / name, "is damaged: it holds no text.") from None

    def table(self, name: str) -> dict[str, Any]:
        """Return a JSON file's table; raises RunError when it is missing or none."""
        text = self.text(name)
        if text is None:
            raise RunError(self.path / name, "is gone, and the log has no copy of it.")
        try:
            found = parse_json(text)
        except ValueError as error:
            raise RunError(self.path / name, f"is damaged: no valid JSON ({error}).") from None
        if not isinstance(found, dict):
            raise RunError(self.path / name, "is damaged: it holds no table.")
        return found

    @cached_property
    def on_disk(self) -> dict[str, str | None]:
        """What the copied files hold now, by name; None: missing or no text."""
        return {name: _text_or_none(self.path / name) for name in {*self.copies, PROVENANCE}}

    def log_is_foreign(self, state_id: Any) -> bool:
        """Whether the log is another run's: no other file has the identifier that it has."""
        by_log = _identifier(self.copies.get(PROVENANCE))
        others = [one for one in (state_id, _identifier(self.on_disk[PROVENANCE])) if one is not None]
        return by_log is not None and bool(others) and by_log not in others

    def problems(self) -> list[FileProblem]:
        """Return what differs from the copies, and SLM images that are not what their names say."""
        found = [
            FileProblem(name, problem, text, MADE_AGAIN)
            for name, text in self.copies.items()
            if (problem := self._problem(name, text)) is not None
        ]
        folder = self.path / SLM_IMAGES
        for image in sorted(folder.iterdir()) if folder.is_dir() else ():
            try:
                same = image.name == slm_image_name(read_bytes(image), image.suffix)
                problem = "" if same else "is not as it was written"
            except (OSError, FileError):
                problem = "cannot be read"
            if problem:
                found.append(FileProblem(f"{SLM_IMAGES}/{image.name}", problem))
        return found

    def _problem(self, name: str, text: str) -> str | None:
        now = self.on_disk[name]
        if now is None:
            return "is gone" if not (self.path / name).exists() else "is no text file any more"
        if now == text or (name not in UNCHANGING and _is_json(now)):
            return None
        return "is not as it was written"


def _text_or_none(path: Path) -> str | None:
    try:
        return read_bytes(path).decode()
    except PermissionError:
        raise
    except (OSError, UnicodeDecodeError, FileError):
        return None


def _is_json(text: str) -> bool:
    try:
        return isinstance(parse_json(text), dict)
    except ValueError:
        return False


def _identifier(provenance: str | None) -> Any:
    """Return the run's identifier by its provenance; None where that is damaged or from before there were."""
    try:
        found = parse_json(provenance or "")
    except ValueError:
        return None
    return found.get("id") if isinstance(found, dict) else None


def log_size(path: Path | str) -> int:
    """Return the bytes of a run's log, 0 without one: it grows with everything that is written."""
    try:
        return (Path(path) / LOG).stat().st_size
    except OSError:
        return 0


def noted_damage(folder: Path) -> tuple[set[int], set[str]]:
    """Return the frames, and the results, that were damaged when a run was last read: to be read again."""
    try:
        noted = NOTED.read(folder / DAMAGED)
        return set(noted["frames"]), set(noted.get("results", ()))
    except (OSError, FileError, LookupError, TypeError):
        return set(), set()


def note_damage(folder: Path, frames: Sequence[int], results: Sequence[str] = ()) -> None:
    """Note, where one may write there, what of a run is damaged; without anything there is no note."""
    with contextlib.suppress(OSError, FileError):
        if frames or results:
            NOTED.write(folder / DAMAGED, {"frames": frames, "results": results})
        else:
            (folder / DAMAGED).unlink(missing_ok=True)


def is_run(path: Path) -> bool:
    """Whether a folder is a run's, even where one of its files is gone."""
    return (path / STATE).is_file() or ((path / LOG).is_file() and (path / PROVENANCE).is_file())


_RUN_FILES = (*UNCHANGING, STATE, LOG, LOCK, FRAMES, SLM_IMAGES, KEPT, DAMAGED)


def refuse_own_files(path: Path) -> None:
    """Refuse to have something else written to what a run or a calibration consists of; beside it may be.

    Raises FileError naming the run or calibration.
    """
    for folder in path.resolve().parents:
        own = path.resolve().relative_to(folder).parts[0]
        for kind, names in (("run", _RUN_FILES), ("calibration", CALIBRATION_FILES)):
            is_own = own in names or any(is_same(folder / own, folder / name) for name in names)
            if is_own and (is_run(folder) if kind == "run" else is_calibration(folder)):
                raise FileError(
                    folder,
                    f"is a {kind}, and {own} is part of it; no output replaces it.",
                    "Choose another name.",
                )


def refuse_within(folder: Path) -> None:
    """Refuse to keep a run within another, however deep: who lists the runs would not find it there.

    Raises RunError naming the folder that it may go to instead.
    """
    try:
        whole = folder.resolve()
    except (OSError, RuntimeError) as error:  # links in a circle
        raise RunError(folder, f"leads nowhere: {error}.", "Choose another folder.") from None
    for place in (whole, *whole.parents):
        if is_run(place) and (place / LOG).is_file():
            where = "is a run" if place == whole else f"is within the run {place.name}"
            raise RunError(
                folder,
                f"{where}; no other run is kept there.",
                f"Name the folder that runs are in, e.g. {place.parent}",
            )
