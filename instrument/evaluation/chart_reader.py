"""Charts of speed against accuracy read back from ``chart.json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from instrument.evaluation.chart_data import SCHEMA
from instrument.files.errors import FileError
from recon.evaluation.scored import KINDS

_MAKE = "Make it with diffuserbench chart."


def read_chart(path: Path) -> dict[str, Any]:
    """Read what ``diffuserbench chart`` wrote.

    Returns
    -------
    dict
        ``kind`` (of :data:`recon.evaluation.scored.KINDS`), ``about`` (what was charted), ``points`` (the
        fields of :class:`recon.evaluation.scored.Point`; None where one is not known), ``failed`` (settings
        and why), ``missing`` (settings without time).

    Raises
    ------
    FileError
        When it is no such file, or of another version.
    """
    try:
        record = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read as JSON: {error}.", _MAKE) from error
    if not is_chart(record):
        raise FileError(path, "holds no chart.", _MAKE)
    if record["schema"] != SCHEMA:
        raise FileError(
            path, f"has version {record['schema']}; this program reads {SCHEMA}.", "Make it again."
        )
    if record.get("kind") not in KINDS:
        raise FileError(path, f"charts {record.get('kind')!r}; known are {', '.join(KINDS)}.", _MAKE)
    found: dict[str, Any] = record
    return found


def is_chart(record: Any) -> bool:
    """Whether a JSON object is a chart of any version."""
    if not isinstance(record, dict) or not {"schema", "about", "points"} <= record.keys():
        return False
    points = record["points"]
    return isinstance(points, list) and all(
        isinstance(p, dict) and {"setting", "iterations", "seconds"} <= p.keys() for p in points
    )
