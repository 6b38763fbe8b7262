"""Stored golden results: an ``.npz`` a case for arrays, one JSON file for numbers and words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parent / "results"
FACTS = FOLDER / "facts.json"


def read(name: str) -> dict[str, Any] | None:
    """Return what is stored of a case; None where nothing is."""
    facts = _facts()
    if name not in facts:
        return None
    with np.load(FOLDER / f"{name}.npz") as arrays:
        return {**facts[name], **arrays}


def write(name: str, result: dict[str, Any]) -> None:
    """Store a case's result; arrays become float32 (the chart's and maps' short tables stay float64)."""
    FOLDER.mkdir(exist_ok=True)
    arrays = {
        k: v if v.size < 500 else v.astype(np.float32) for k, v in result.items() if isinstance(v, np.ndarray)
    }
    np.savez_compressed(FOLDER / f"{name}.npz", **arrays)
    facts = _facts() | {name: {k: v for k, v in result.items() if k not in arrays}}
    FACTS.write_text(json.dumps(dict(sorted(facts.items())), indent=1, sort_keys=True) + "\n")


def names() -> set[str]:
    """Return the cases that are stored."""
    return set(_facts())


def forget(name: str) -> None:
    """Remove a case that is no more."""
    (FOLDER / f"{name}.npz").unlink(missing_ok=True)
    FACTS.write_text(
        json.dumps({k: v for k, v in _facts().items() if k != name}, indent=1, sort_keys=True) + "\n"
    )


def _facts() -> dict[str, Any]:
    return dict(json.loads(FACTS.read_text())) if FACTS.exists() else {}


def differences(found: dict[str, Any], kept: dict[str, Any], tolerance: float) -> list[str]:
    """Say in which parts a result is not the stored one, to rounding; words and counts must be equal."""
    said = [
        f"{name}: only {'here' if name in found else 'stored'}" for name in sorted(found.keys() ^ kept.keys())
    ]
    for name in sorted(found.keys() & kept.keys()):
        here, there = found[name], kept[name]
        if isinstance(here, np.ndarray):
            said += _apart(name, here, there, tolerance)
        elif isinstance(here, float) and isinstance(there, float):
            if abs(here - there) > min(10 * tolerance, 2e-3) * abs(there) + 1e-12:
                said.append(f"{name}: {here!r}, stored {there!r}")
        elif here != there:
            said.append(f"{name}: {here!r}, stored {there!r}")
    return said


def _apart(name: str, here: Any, there: Any, tolerance: float) -> list[str]:
    if here.shape != there.shape:
        return [f"{name}: shape {here.shape}, stored {there.shape}"]
    if not np.array_equal(np.isnan(here), np.isnan(there)):
        return [f"{name}: not a number in other places"]
    apart = float(np.linalg.norm(np.nan_to_num(here.astype(float) - there.astype(float))))
    size = float(np.linalg.norm(np.nan_to_num(there.astype(float))))
    return (
        []
        if apart <= tolerance * size
        else [f"{name}: differs by {apart / max(size, 1e-30):.2g} of its norm"]
    )
