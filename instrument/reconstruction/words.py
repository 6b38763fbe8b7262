"""How a reconstruction's settings are written as words, on the command line and in the window's fields."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from instrument.files.errors import BenchError
from instrument.reconstruction.erasures import Choice
from instrument.reconstruction.job import DarkChoice, NoiseChoice
from recon.base.noise import NoiseModel
from recon.errors import InputError
from recon.reconstruction.overrides import PRECISIONS, Precision, Wishes


def parse_dark(text: str) -> DarkChoice:
    """Read ``auto``, an offset in counts, or the name of a dark frame.

    Raises
    ------
    BenchError
        When it is a number that is not finite.
    """
    if text == "auto":
        return "auto"
    try:
        counts = float(text)
    except ValueError:
        return Path(text)
    if not math.isfinite(counts):
        raise BenchError(f"--dark {text}: the offset must be a finite number of counts.")
    return counts


def parse_erasures(text: str) -> Choice:
    """Read ``none``, ``saturated``, a share of the pixels, or the name of a mask."""
    if text == "none":
        return "none"
    if text == "saturated":
        return "saturated"
    try:
        return float(text)
    except ValueError:
        return Path(text)


def parse_binning(text: str) -> int | None:
    """Read a whole number from 1, or ``auto`` (None).

    Raises
    ------
    BenchError
    """
    if text == "auto":
        return None
    if not re.fullmatch(r"[1-9]\d*", text):
        raise BenchError(f"--bin {text!r} is not understood; write a whole number from 1, or auto.")
    return int(text)


def parse_noise(text: str | None) -> NoiseChoice:
    """Read ``COUNTS``, ``READ,GAIN`` (read noise in counts, counts per electron) or ``estimate``.

    Raises
    ------
    BenchError
    """
    if text is None:
        return None
    if text == "estimate":
        return "estimate"
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(math.isfinite(v) and v >= 0 for v in values):
        raise BenchError(
            f"--noise {text!r} is not understood; write a standard deviation in counts (3.5), or read noise "
            "in counts and counts per electron (2.1,0.13), or estimate."
        )
    return values[0] if len(values) == 1 else NoiseModel(*values)


def parse_precision(text: str, wishes: Wishes | None) -> Precision | None:
    """Read ``float32``, ``float64``, or ``auto`` (None).

    Raises
    ------
    BenchError
        When it is something else, or said twice.
    """
    if text == "auto":
        return None
    found = next((precision for precision in PRECISIONS if precision == text), None)
    if found is None:
        raise BenchError(f"--precision {text!r} is not known; choose one of auto, {', '.join(PRECISIONS)}.")
    if wishes is not None and wishes.precision is not None:
        raise BenchError("--precision and --choose precision=... say the same twice: leave one of them out.")
    return found


def parse_wishes(model: str, texts: Sequence[str]) -> Wishes | None:
    """Read ``NAME=VALUE`` each; None where there are none.

    Raises
    ------
    BenchError
        When one is not understood, or the camera model is not left to the program.
    """
    if not texts:
        return None
    if model != "auto":
        raise BenchError(
            f"--choose overrules what --model auto chooses; it does not go with --model {model}."
        )
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise BenchError(f"--choose {text!r} is not understood; write NAME=VALUE, say binning=1.")
        pairs[name.strip()] = value.strip()
    try:
        return Wishes.parse(pairs)
    except InputError as error:
        raise BenchError(f"--choose: {error}") from error
