"""Long steps say how long they take: by what they did, or by what they took last time; and what compiles."""

from __future__ import annotations

import io
import logging
import os
import re
import sys
import time
from pathlib import Path
from typing import cast

import pytest
from rich.console import Console
from rich.progress import Progress

from instrument.cli import main, progress
from instrument.cli.progress import _Left, _Note, one_task
from instrument.files import kept_times


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kept_times, "WORTH_S", 0.0)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    return kept_times.place()


def test_a_step_is_expected_to_take_as_long_as_last_time(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_times.about("snap")
    assert kept_times.expected("reading") is None
    with kept_times.kept("reading"):
        time.sleep(0.02)
    told = kept_times.expected("reading")
    assert told is not None
    assert told.seconds >= 0.02
    kept_times.about("another command")
    assert kept_times.expected("reading") is None
    kept_times.about("snap")
    with pytest.raises(OSError, match="lost"), kept_times.kept("reading"):
        raise OSError("lost")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False)
    monkeypatch.setattr(kept_times, "_window", False)  # a test of the window may have been before
    with kept_times.kept("reading"):
        time.sleep(0.05)
    assert kept_times.expected("reading") == told, "nobody saw it"
    numbers = ("[0, 1]", '"soon"', "NaN", "Infinity", "-5", f"1{400 * '0'}")
    for damaged in ("", "[]", 90_000 * "[", *(f'{{"snap: reading": {number}}}' for number in numbers)):
        cache.write_text(damaged)
        assert kept_times.expected("reading") is None


def test_the_first_time_a_simulated_scene_is_exposed_goes_by_how_quick_this_machine_is_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step = "Finding the scene's exposure"
    quick, slow = 0.01, 0.05
    monkeypatch.setattr(kept_times, "transform_s", lambda: quick)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    kept_times.about("real bench")
    assert kept_times.expected(step) is None
    kept_times.about("small", megapixels=0.08, simulated=True)
    assert kept_times.expected(step) is None, "not worth a word"
    kept_times.about("large", megapixels=5.5, simulated=True, awaits_light=lambda: True)
    told = kept_times.expected(step)
    assert told is not None
    assert 1 < told.seconds < 20
    assert told.by != "last time"
    monkeypatch.setattr(kept_times, "transform_s", lambda: slow)
    busy = kept_times.expected(step)
    assert busy is not None
    assert busy.seconds == pytest.approx(slow / quick * told.seconds)
    monkeypatch.setattr(os, "getloadavg", lambda: (100.0, 0.0, 0.0))
    waiting = kept_times.expected(step)
    assert waiting is not None
    assert waiting.seconds > 2 * busy.seconds
    kept_times.remember(f"large: {step} with its light", 4.0)
    assert kept_times.expected(step) == (4.0, "last time")


def test_light_that_was_kept_is_not_waited_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    step, awaited = "Finding the scene's exposure", [True]
    monkeypatch.setattr(kept_times, "transform_s", lambda: 0.01)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    kept_times.about("large", megapixels=5.5, simulated=True, awaits_light=lambda: awaited[0])
    first = kept_times.expected(step)
    with kept_times.kept(step):
        awaited.clear()
        awaited.append(False)  # it is computed, and kept
    second = kept_times.expected(step)
    assert first is not None
    assert second is not None
    assert second.by == "a first guess"
    assert second.seconds < first.seconds / 4
    assert kept_times.expected("Frames") is None, "a moment"
    awaited[0] = True
    assert kept_times.expected("Frames") is not None
    awaited.clear()  # a camera that fails: asked for a time it ends nothing
    assert kept_times.expected("Frames") is None


def test_the_first_page_is_drawn_in_about_so_long_on_any_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_times, "transform_s", lambda: 0.01)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    kept_times.about("analyze")
    for what in ("Drawing", "drawing"):
        told = kept_times.expected(what)
        assert told is not None
        assert 0.5 < told.seconds < 3


def test_what_takes_long_is_told_the_first_time_too_each_of_what_it_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kept_times, "transform_s", lambda: 0.01)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    kept_times.about("table7.1")
    with one_task("table 7.1", 8):
        few = kept_times.expected("table 7.1", 8)
        assert few is not None
        many = kept_times.expected("table 7.1", 96)
        assert many is not None
        assert many.seconds == pytest.approx(12 * few.seconds)
    kept_times.about("real bench", megapixels=5.5)
    analysing = kept_times.expected("analysing")
    assert analysing is not None
    assert analysing.by == "a first guess"
    kept_times.about("small bench", megapixels=0.3)
    assert kept_times.expected("analysing") is None, "a moment"


def test_a_step_that_was_counted_is_told_by_its_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_times, "transform_s", lambda: 0.01)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    kept_times.about("calibrate", megapixels=5.5)
    told = []
    for transforms in (1000.0, 3000.0):
        kept_times.counted(transforms)
        expected = kept_times.expected("blind deconvolution")
        assert expected is not None
        told.append(expected.seconds)
    assert 0 < told[1] == pytest.approx(3 * told[0])


def test_a_step_of_several_parts_is_expected_to_take_as_long_until_the_first_is_done() -> None:
    kept_times.about("compare")
    kept_times.remember("compare: comparing of 100", 50.0)
    kept_times.remember("compare: Frames", 7.0)
    with one_task("comparing", 100):
        pass
    assert kept_times.expected("comparing of 100") != (50.0, "last time"), "what it took now"
    before = kept_times.expected("comparing of 100")
    with one_task("comparing", 100, done=50):
        pass
    assert kept_times.expected("comparing of 100") == before, "half of it is not all"


def test_the_oldest_times_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_times, "MOST", 2)
    for name in ("a", "b", "a", "c"):
        with kept_times.kept(name):
            pass
    assert [kept_times.expected(name) is None for name in ("a", "b", "c")] == [False, True, False]


def test_a_terminal_is_told_that_a_command_is_on_its_way(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)  # this test's own
    assert main(["drivers"]) == 0
    assert capsys.readouterr().err.startswith("starting drivers ...\r\x1b[2K")
    assert not logging.getLogger("matplotlib.font_manager").isEnabledFor(logging.WARNING)  # the first page's


def test_a_bar_says_what_is_left_and_what_is_compiled() -> None:
    from numba.core import event

    clock_s = [100.0]
    bar = Progress(get_time=lambda: clock_s[0])
    bar.add_task("Finding the exposure", total=None, note="", expected=kept_times.Expected(60.0, "last time"))
    task = bar.tasks[0]
    assert str(_Left().render(task)).endswith(" left, as last time")
    task.fields["expected"] = kept_times.Expected(1.0, "last time")
    clock_s[0] += 2
    assert "longer than last time" in str(_Left().render(task))
    bar.update(task.id, total=10, completed=0)
    assert "longer than last time" in str(_Left().render(task)), "until the first of them is done"
    task.fields["expected"] = None
    assert str(_Left().render(task)).startswith("left -")
    task.start_time = task.get_time() - 30
    task.completed = 3  # the first that was done: there is no speed yet
    assert str(_Left().render(task)) == "left about 70.0 s"
    bar.update(task.id, total=10, completed=4)
    assert str(_Left().render(task)).startswith("left ")
    column = _Note()
    assert not str(column.render(task))

    class Kernel:
        @staticmethod
        def py_func() -> None: ...

    with event.trigger_event("numba:compile", data={"dispatcher": Kernel}):
        assert str(column.render(task)) == "compiling py_func (once)"
    assert not str(column.render(task))


@pytest.mark.parametrize("width", [80, 120])
def test_times_are_whole_in_a_narrow_terminal_and_the_note_gives_way(
    width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    monkeypatch.setattr(progress, "Console", lambda **_: shown)
    with progress.progress_bar() as bar:
        task = bar.add_task("picture", total=100, note="iteration 12, change 2.7e-02; " * 4)
        bar.update(task, advance=57)
        page = Console(file=io.StringIO(), width=width, color_system=None)
        page.print(bar.get_renderable())
    line = cast(io.StringIO, page.file).getvalue().rstrip("\n")
    assert "\n" not in line
    assert re.search(r"picture .+ 57/100 0:00:00 left about \S+ s +iter.*…", line), line


def test_a_transform_is_tried_in_little_time() -> None:
    began_s = time.process_time()
    assert 0 < kept_times.transform_s() <= time.process_time() - began_s
