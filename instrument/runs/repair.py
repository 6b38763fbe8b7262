"""Mending a run's folder: files made again from their copies, a log without its bad lines.

Nothing is thrown away: what is replaced or cut out goes into the run's folder ``kept``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zlib import crc32

from instrument.files.atomic import json_text, sync_folder, write_bytes
from instrument.files.errors import FileError, frames_in_words, ranges
from instrument.files.reading import parse_json, read_bytes
from instrument.files.record import plain
from instrument.runs.frame_array import DESCRIPTIONS, FrameArray
from instrument.runs.frame_facts import descriptions
from instrument.runs.log import AppendOnlyLog, Lost, Unlisted, log_line, read_lines
from instrument.runs.run import Run
from instrument.runs.run_files import (
    FRAMES,
    KEPT,
    LOG,
    MADE_AGAIN,
    PROVENANCE,
    RUN_STATE,
    STATE,
    UNCHANGING,
    FileProblem,
    RunError,
    copies_of,
)

_CUT = "cuts out of the log what cannot be read"


def file_problems(run: Run) -> list[FileProblem]:
    """Return which of a run's small files, log included, are not as they were written."""
    if run.log_is_foreign:
        return [FileProblem(LOG, "is another run's, and was not used")]
    found: list[FileProblem] = []
    if not (run.path / LOG).is_file():
        found.append(FileProblem(LOG, "is gone", remedy="begins a new log"))
    for bad in run.bad_lines:
        if not bad.is_torn:
            found.append(
                FileProblem(LOG, f"line {bad.number} cannot be read ({len(bad.data)} bytes)", remedy=_CUT)
            )
        elif not run.is_being_written:
            found.append(FileProblem(LOG, f"it ends in a half line of {len(bad.data)} bytes", remedy=_CUT))
    found += run.files.problems()
    if (problem := _state_problem(run)) is not None:
        found.append(problem)
    return found + _array_problems(run)


def _state_problem(run: Run) -> FileProblem | None:
    """Hold ``state.json`` against the log."""
    if run.state_problem:
        return FileProblem(STATE, run.state_problem, RUN_STATE.text(run.state), MADE_AGAIN)
    if PROVENANCE not in run.files.copies:
        return None
    by_log = run.state_by_log()
    both_ended = by_log["state"] == run.state["state"] == "finished"
    names = ["label", "simulated", "id", *(["reason"] if both_ended else [])]
    wrong = [name for name in names if name in by_log and run.state.get(name) != by_log[name]]
    if not wrong:
        return None
    words = "; ".join(f"{name} is {run.state.get(name)!r:.60}, not {by_log[name]!r:.60}" for name in wrong)
    return FileProblem(STATE, f"says what the log does not: {words}", RUN_STATE.text(by_log), MADE_AGAIN)


def _array_problems(run: Run) -> list[FileProblem]:
    """Hold the images' descriptions against what must be in them."""
    if not run.has_frames or not run.records:
        return []
    array = run.array
    n_frames = array.n_frames if run.plan is None else len(run.plan)
    wanted, group = descriptions(run, n_frames)
    sums = run.events[-1].get("descriptions", {}) if run.events else {}  # of "finished"
    found = []
    for name, expected, look in ((DESCRIPTIONS[0], wanted, _reading_of), (DESCRIPTIONS[1], group, _scale_of)):
        try:
            data = read_bytes(array.path / name)
            same = look(parse_json(data)) == look(expected) and sums.get(name, crc32(data)) == crc32(data)
            problem = "" if same else "is not as it was written"
        except FileNotFoundError:
            problem = "is gone"
        except (FileError, LookupError, TypeError, ValueError, AttributeError):
            problem = "is damaged"
        if problem:
            found.append(FileProblem(f"{FRAMES}/{name}", problem, json_text(expected), MADE_AGAIN))
    return found


def _reading_of(array: dict[str, Any]) -> list[object]:
    """Return what decides how an array is read."""
    keys = "zarr_format", "node_type", "data_type", "chunk_grid", "chunk_key_encoding", "fill_value", "codecs"
    return [*(array[key] for key in keys), array["shape"]]


def _scale_of(group: dict[str, Any]) -> object:
    """Return where an image's pixels are and how far from each other."""
    dataset = group["attributes"]["ome"]["multiscales"][0]["datasets"][0]
    return dataset["path"], dataset["coordinateTransformations"][0]["scale"][-2:]


def mend_files(path: Path) -> list[str]:
    """Make a locked run's damaged small files again; returns what was done, in words.

    Raises RunError when the log is another run's, or a file that nothing tells of is damaged.
    """
    run = Run.open(path)
    if run.log_is_foreign:
        raise RunError(
            path / LOG,
            "is another run's; nothing was changed.",
            "Put the run's own log back, or move this one away: the images are kept either way.",
        )
    done = []
    if run.bad_lines:
        kept = keep_beside(path, LOG, b"".join(bad.data for bad in run.bad_lines))
        records, _ = read_lines(path / LOG)
        write_bytes(path / LOG, b"".join(map(log_line, records)))
        done.append(f"what could not be read of the log was cut out and is kept in {KEPT}/{kept.name}")
    for problem in file_problems(run):
        if problem.text is None:
            continue
        target = path / problem.name
        words = f"{problem.name} was made again"
        if os.path.lexists(target):  # a folder or a pipe, too
            words += f"; the old one is kept in {KEPT}/{keep_beside(path, problem.name).name}"
        write_bytes(target, problem.text.encode())
        done.append(words)
    FrameArray.remove_draft(path / FRAMES)
    if FrameArray.is_there(path / FRAMES):
        run.array.remove_half_written()
    beyond = [index for index in run.without_a_line() if run.plan is not None and index >= len(run.plan)]
    for index in beyond:
        keep_beside(path, str(run.array.chunk_path(index).relative_to(path)))
    if beyond:
        done.append(f"images {ranges(beyond, 8)}, beyond the plan's, are kept in {KEPT}")
    _renew_copies(path)
    return done


def _renew_copies(path: Path) -> None:
    """Give a log that lacks them (an older run's, or a new one) copies of the small files."""
    run = Run.open(path)
    absent = [name for name in UNCHANGING if name not in run.files.copies and (path / name).is_file()]
    texts = {name: text for name in absent if (text := run.files.text(name)) is not None}
    if not texts:
        return
    log = AppendOnlyLog(path / LOG)
    try:
        log.append(copies_of(texts))
    finally:
        log.close()


def keep_beside(path: Path, name: str, data: bytes | None = None) -> Path:
    """Move a file of a run, or write ``data``, into the run's folder of kept things; returns where it is."""
    folder = path / KEPT
    if not folder.is_dir():
        folder.mkdir()
        sync_folder(path)
    stamp = f"{datetime.now(UTC):%Y%m%dT%H%M%S}"
    number = 1
    while (target := folder / f"{stamp}-{number}_{name.replace('/', '_')}").exists():
        number += 1
    if data is not None:
        write_bytes(target, data)
    else:
        (path / name).rename(target)
        sync_folder(folder)
    return target


def settle_recording(run: Run, log: AppendOnlyLog, damaged: Mapping[int, str]) -> list[str]:
    """Say in a recording's log what became of frames that are not as they were; returns it in words.

    Images without a line are kept where they are, with their checksum; those of a wrong size are lost.
    ``damaged``: what is wrong, by frame.
    """
    found = run.without_a_line()
    array = run.array if found else None
    lines: list[Unlisted | Lost] = [Lost(index, why) for index, why in damaged.items()]
    for index in found:
        assert array is not None
        whole = array.n_bytes(index) == array.frame_bytes
        chunk = array.checksum(index) if whole else None
        if chunk is not None:
            lines.append(Unlisted(index, chunk.n_bytes, f"{chunk.crc32:08x}"))
        else:
            lines.append(Lost(index, "neither its line in the log nor a whole image is left"))
    log.append({"kind": type(line).__name__.lower(), **plain(line)} for line in lines)
    lost = [line.index for line in lines if isinstance(line, Lost)]
    kept = [line.index for line in lines if isinstance(line, Unlisted)]
    words = []
    if lost:
        words.append(f"marked as lost: {frames_in_words(lost)}")
    if kept:
        words.append(f"kept without their metadata: images of {frames_in_words(kept)}")
    return words
