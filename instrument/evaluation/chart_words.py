"""Charts in words and colours, alike in the picture, the page and the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from instrument.evaluation.chart_data import ChartData
from recon.evaluation.scored import Point

COLOURS = ("#00798c", "#d1495b", "#d98e04", "#4f8a5b", "#5b6ee1", "#b04fc4", "#7a5c3e", "#e0559a")
"""Told apart on white and on black."""


def colours_of(data: ChartData) -> dict[str, str]:
    """Give every family of settings a colour."""
    names = sorted({p.family for p in data.points})
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def in_words(point: Point) -> str:
    """Return a setting, and how often it was iterated where that was counted."""
    return f"{point.setting}, {point.iterations} it." if point.iterations else point.setting


def title_of(data: ChartData) -> str:
    """Return what was charted, of what."""
    what = {
        "reconstruction": "Reconstructions, speed against accuracy",
        "hologram": "Holograms, time against quality",
        "calibration": "Calibrations, photographs against the error of what is reconstructed",
    }[data.kind_name]
    pixels = " x ".join(str(n) for n in data.about.get("pixels", ()))
    return f"{what}: {subject_of(data.kind_name, data.about)}, {pixels} pixels"


def subject_of(kind: str, about: Mapping[str, Any]) -> str:
    """Return the scene, picture, photograph or bench that was charted."""
    if kind == "hologram":
        return ", ".join(Path(str(p)).name for p in about.get("pictures", ())) + " on the SLM"
    inputs = about.get("inputs") or {}
    if kind == "calibration" and not inputs:
        return "the simulated microscope"
    return Path(str(about.get("scene") or (inputs.get("image") or {}).get("path", "photograph"))).name
