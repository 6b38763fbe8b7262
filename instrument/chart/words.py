"""Charts in words and colours, alike in the picture, the page and the terminal."""

from __future__ import annotations

from pathlib import Path

from instrument.chart.data import ChartData
from recon.chart.scored import Point

COLOURS = ("#00798c", "#d1495b", "#d98e04", "#4f8a5b", "#5b6ee1", "#8d6a9f", "#7a5c3e", "#e0559a")
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
    about = data.about
    pixels = " x ".join(str(n) for n in about.get("pixels", ()))
    if data.kind_name == "hologram":
        names = ", ".join(Path(str(p)).name for p in about.get("pictures", ()))
        return f"Holograms, time against quality: {names}, SLM of {pixels} pixels"
    if data.kind_name == "calibration":
        return f"Calibrations, photographs against the error of what is reconstructed: {pixels} pixels"
    what = about.get("scene") or (about.get("inputs") or {}).get("image", {}).get("path", "photograph")
    return f"Reconstructions, speed against accuracy: {Path(str(what)).name}, {pixels} pixels"
