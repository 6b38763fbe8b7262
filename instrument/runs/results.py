"""What was made of a run's frames and lies in its folder: whether it can still be read."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from instrument.files.atomic import DOUBTFUL
from instrument.files.calibration_file import CALIBRATION_FILES, check_calibration
from instrument.files.errors import FileError
from instrument.files.images import read_image
from instrument.files.reading import parse_json, read_bytes
from instrument.runs.run_files import FileProblem

PHOTOGRAPH_FILE = "photograph.tif"
"""What ``calibrate photograph`` makes of its frames."""
ANGULAR_FILE, SURFACE_FILE, STAGE_FILE = "angular_response.json", "dpc.json", "stage.json"
"""What ``calibrate angular``, ``dpc`` and ``stage`` make of theirs."""
BEADS_FILE, RETAKES_FILE = "went_on.json", "retakes.json"
"""In which later runs a bead slide goes on, or points of a sweep were taken again."""
RESULT_FILES = (ANGULAR_FILE, SURFACE_FILE, STAGE_FILE, BEADS_FILE, RETAKES_FILE)
"""What else ends in ``.json`` in a run's folder is the run's own, or somebody else's."""
_HEIGHT = "height_file"
"""In a surface's JSON: the name of the file of its numbers."""


def result_problems(run: Path, *, read: bool = True, noted: Collection[str] = ()) -> list[FileProblem]:
    """Return which calibrations, photographs and JSON files of results in a run's folder are damaged.

    ``read``: False reads of a calibration its record only, and PSFs and pictures where these are among the
    ``noted``.
    """
    found = []
    for path in _results(run):
        name = path.relative_to(run).as_posix()
        try:
            _look_at(path, read=read or name in noted)
        except FileError as error:
            inner = error.path.relative_to(path).as_posix() if error.path.is_relative_to(path) else "."
            whole = name if inner == "." else f"{name}/{inner}"
            found.append(FileProblem(whole, f"{error.problem} {error.remedy}".strip(), of=name))
        except (OSError, ValueError) as error:
            found.append(FileProblem(name, f"is damaged: {error}.", of=name))
    return found


def _results(run: Path) -> Iterator[Path]:
    for path in sorted(run.iterdir()):
        made = path.name.removeprefix(DOUBTFUL) in (PHOTOGRAPH_FILE, *RESULT_FILES)
        calibration = any((path / part).exists() for part in CALIBRATION_FILES)
        if made or (calibration and not path.name.startswith(".")):
            yield path


def _look_at(path: Path, *, read: bool) -> None:
    """Raise FileError, OSError or ValueError where a result cannot be read."""
    if path.name.removeprefix(DOUBTFUL) == PHOTOGRAPH_FILE:
        if read:
            read_image(path)
    elif path.name.removeprefix(DOUBTFUL) in RESULT_FILES:
        record = parse_json(read_bytes(path))
        numbers = record.get(_HEIGHT) if isinstance(record, dict) else None
        if isinstance(numbers, str) and read:
            read_image(path.with_name(numbers), holes=True)
    else:
        check_calibration(path, read=read)
