"""Messages of the terminal in the window: what is said to be done is done here."""

from __future__ import annotations

import ast
import logging
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import instrument
from gui.session_news import LogBridge
from gui.words import in_the_log, in_the_window, in_two_lines, level_of

ROOT = Path(instrument.__file__).parents[1]
_IN_WINDOW = ("recon", "instrument", "calibration_routines")


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        (
            "12 of 40 frames are kept. For the others: diffuserbench resume /runs/2026-11-25_axial",
            "12 of 40 frames are kept. For the others: “Go on with it”, or “Resume” in Runs",
        ),
        (
            "diffuserbench verify RUN names every damaged frame.",
            "“Verify runs” in Files names every damaged frame.",
        ),
        ("Make one: diffuserbench align mask", "Make one: Alignment"),
        ("x, y, z in um, as a table; in um/raw.tif", "x, y, z in µm, as a table; in um/raw.tif"),
        ("with 6 ('reconstruct --video --warm').", "with 6 (“Reconstruct a recording” in Files)."),
        ("is no video of 'reconstruct --video'.", "is no video of “Reconstruct a recording” in Files."),
        ("install diffuserbench again", "install diffuserbench again"),
        (
            "led_array (simulated): was unplugged; slm (simulated) too. Plug it in, then open it again.",
            "LED array (simulated): was unplugged; SLM (simulated) too. Plug it in, then reconnect it.",
        ),
        ("3 settings: run the same command again to go on.", "3 settings: “Start” again to go on."),
        ("The same command goes on with the rest.", "“Start” goes on with the rest."),
        (
            "Choose another name, or overwrite with --force.",
            "Choose another name, or overwrite with “Overwrite”.",
        ),
        ("4.1 % larger (falls to 78%), 5%.", "4.1 % larger (falls to 78 %), 5 %."),
        ("/data/50%/x and 50%-off", "/data/50%/x and 50 %-off"),
        ("/data/run 50%.tif, ./run50%: 5%", "/data/run 50%.tif, ./run50%: 5 %"),
        (r"C:\a 1\run50%, --dark 5%, --dark=5%; 5%", r"C:\a 1\run50%, --dark 5%, --dark=5%; 5 %"),
        ("d 8.82 +- 0.14 mm, off by 1.7 um (--reach-um).", "d 8.82 ± 0.14 mm, off by 1.7 µm (--reach-um)."),
    ],
)
def test_commands_are_the_windows_own_ways(said: str, shown: str) -> None:
    assert in_the_window(said) == shown


def test_no_message_sends_to_the_terminal() -> None:
    left = {words for words in _messages() if re.search(r"diffuserbench [a-z]", in_the_window(words))}
    assert not {words for words in left if "serve" not in words and "install" not in words}


def _messages() -> Iterator[str]:
    """Yield the sentences in the program's texts: neither examples of commands nor documentation."""
    for file in (path for room in _IN_WINDOW for path in (ROOT / room).rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if "diffuserbench " not in text or "cli" in file.parts:
            continue
        tree = ast.parse(text)
        documents = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            said = node.value if isinstance(node, ast.Constant) and id(node) not in documents else None
            if isinstance(said, str) and not re.search(r"^diffuserbench |^ *[#\[]", said, re.MULTILINE):
                yield said


def test_the_log_names_no_module_of_this_program() -> None:
    lines: list[tuple[str, str]] = []
    bridge = LogBridge(lambda *line: lines.append(line))
    for name in ("instrument.bench.bench", "drivers.stage", "pypylon"):
        bridge.emit(logging.LogRecord(name, logging.INFO, "", 0, "opened", None, None))
    assert [text for _, text in lines] == ["opened", "opened", "pypylon: opened"]


def test_the_log_names_no_options_of_the_terminal() -> None:
    said = "Find activity: Give either --psf FILE or --calibration FOLDER; --dry-run tells all of it."
    assert in_the_log(said) == (
        "Find activity: Give either “psf” FILE or “calibration” FOLDER; “dry run” tells all of it."
    )


@pytest.mark.parametrize(
    "path",
    [
        "/home/u/a--b/run",
        "/home/u/--dry-run/run",
        r"C:\u\--dry-run",
        "a--b",
        "/home/x/slm (copy)/run: y",
        "/home/x/led_array: y",
        "/home/x/led_array (2)",
        r"C:\x\slm (copy)",
    ],
)
def test_the_log_leaves_paths_as_they_are(path: str) -> None:
    """Who copies one from there would find nothing."""
    assert in_the_log(f"Wrote {path}") == f"Wrote {path}"


def test_the_log_names_options_behind_brackets_and_quotes() -> None:
    assert in_the_log("--psf, (--calibration) or '--dry-run'") == "“psf”, (“calibration”) or '“dry run”'"


def test_a_warning_of_a_command_says_no_word_that_the_log_says() -> None:
    assert level_of("Warning: frames move.") == ("warning", "Frames move.")
    assert level_of("Note: 3 depths are few.") == ("info", "3 depths are few.")
    assert level_of("one.tif: 3 frames are damaged") == ("warning", "one.tif: 3 frames are damaged")


def test_heads_of_columns_stand_on_two_lines() -> None:
    assert in_two_lines("field of view, deg") == "field of\nview, deg"
    assert in_two_lines("expansion") == "expansion"
