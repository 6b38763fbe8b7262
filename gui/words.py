"""How the window says things: what commands are called here, signs, and numbers with their units."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from typing import Literal

from recon.base.declare import in_other_words

_ELSEWHERE = {
    "resume": "“Go on with it”, or “Resume” in Runs",
    "list": "Runs",
    "snap": "“Snap” in the live view",
    "record": "“Record” in the live view",
    "run": "a plan in Sweeps",
    "plan": "a plan in Sweeps",
    "plan illumination": "“Patterned light” in Sweeps",
    "calibrate": "Sweeps",
    "align": "Alignment",
    "hologram": "Holograms",
    "reconstruct": "Reconstructions",
    "chart": "a chart in Files",
    "new": "a simulated bench of the start page",
    "devices": "“New bench from what is connected” on the start page",
}
"""What is no task of its own in the panel Files."""
_AGAIN = re.compile(r"\b(?:[Rr]un the|[Tt]he) same command\b")
"""What goes on where it stopped, as a form's button does."""
_REST = r"(?:\s+(?:--[a-z][a-z-]*|[A-Z]{3,}|mask|slm|illumination|(?:/|[A-Za-z]:\\)\S*[^\s.,;:]))*"
"""Of a command: its sub-command, options, places and paths."""


_FORCE = re.compile(r"--force(?![\w-])")
"""The same field in every form that has it."""
_NO_PATH, _NO_FOLDER = r"(?<![/\\\w])", r"(?![^()]*\)[/\\])"
"""Neither in a folder nor the name of one: a file is found by its name as it is."""
_SIGNS = (
    (re.compile(r"(?<=\d) um\b(?![/\\])"), " µm"),
    (re.compile(r"(?:\bin|,) um\b(?![/\\])"), lambda found: found[0].replace("um", "µm")),
    (re.compile(r"\+-(?=[ \d])"), "±"),
    (
        re.compile(r"(?:\S*[/\\]|--[a-z][a-z-]*[ =])\S*|(?<=\d)%(?![\w%]|\.\w)"),
        lambda found: " %" if found[0] == "%" else found[0],
    ),
    (re.compile(rf"{_NO_PATH}led_array(?= opened|:| \({_NO_FOLDER})"), "LED array"),
    (re.compile(rf"{_NO_PATH}slm(?= \({_NO_FOLDER})"), "SLM"),
    (re.compile(r"\bopen it again\b"), "reconnect it"),
)
"""Units and signs as the window has them, and what its buttons say: a terminal may lack both."""
_MM_UM = 1e3
THIN = "\u2009"
"""Between groups of three digits."""


def in_the_window(text: str) -> str:
    """Return a message with the window's own ways in place of the terminal's commands, and its signs."""
    ways, command = _ways()
    text = _FORCE.sub("“Overwrite”", command.sub(lambda found: ways[found[1] or found[2]], text))
    return with_signs(_AGAIN.sub("“Start”", text))


def in_the_log(text: str) -> str:
    """Return a message as ``in_the_window``, also without the terminal's options: no form is at hand."""
    return in_other_words(in_the_window(text), (), str, lambda flag: f"“{flag[2:].replace('-', ' ')}”")


def level_of(text: str) -> tuple[Literal["info", "warning"], str]:
    """Return how much a warning of a command says, and it without its first word, which a log's own has."""
    word, colon, rest = text.partition(": ")
    if colon and word in ("Note", "Warning"):
        return ("info" if word == "Note" else "warning"), rest[:1].upper() + rest[1:]
    return "warning", text


def in_two_lines(words: str) -> str:
    """Return words on two lines as alike in length as their spaces allow: for the head of a column."""
    gaps = [place for place, letter in enumerate(words) if letter == " "]
    if not gaps:
        return words
    gap = min(gaps, key=lambda place: abs(2 * place - len(words)))
    return f"{words[:gap]}\n{words[gap + 1 :]}"


def with_signs(text: str) -> str:
    """Return a text with units, signs and kinds of devices as the window has them elsewhere."""
    for pattern, sign in _SIGNS:
        text = pattern.sub(sign, text)
    return text


@functools.cache
def _ways() -> tuple[Mapping[str, str], re.Pattern[str]]:
    from instrument.tasks import TASKS  # of a dozen modules: not before the window is there

    ways = {name: f"“{task.title}” in Files" for name, task in TASKS.items()} | _ELSEWHERE
    ways["reconstruct --video"] = ways["video"]
    names = "|".join(map(re.escape, sorted(ways, key=len, reverse=True)))
    return ways, re.compile(rf"'(?:diffuserbench )?({names}){_REST}'|\bdiffuserbench ({names})\b{_REST}")


def grouped(digits: str) -> str:
    """Return a number's digits with thin spaces between thousands, from five digits before the point on."""
    whole, point, rest = digits.partition(".")
    bare = whole.lstrip("-")
    if len(bare) < 5 or not bare.isdecimal():
        return digits
    return f"{int(whole):,}".replace(",", THIN) + point + rest


def quantity(value: float, unit: str, digits: int = 4) -> str:
    """Return a number with its unit as people read it: lengths from 1 mm on in mm, thousands apart."""
    unit = "µm" if unit == "um" else unit
    if unit == "µm" and abs(value) >= _MM_UM:
        value, unit = value / _MM_UM, "mm"
    written = f"{value:.{digits}g}"
    if "e+" in written:
        written = f"{value:.0f}"
    return f"{grouped(written)} {unit}".strip()
