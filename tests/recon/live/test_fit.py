"""When live pictures are checked against their calibration, without a picture."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from recon.reconstruction.decoys import AMONG
from recon.streams import fit
from recon.streams.fit import CalibrationWatch
from recon.streams.stillness import SceneState


class Watched:
    """A watch whose checks take no time, and how many there were."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, says: str = "") -> None:
        monkeypatch.setattr(fit, "FIRST_S", 0.0)
        monkeypatch.setattr(fit, "_found", lambda *_: fit._Found(says, "advice", 0.0))
        self.watch, self.checks = CalibrationWatch(), 0

    def see(self, scene: SceneState, frames: int) -> int:
        """Show a picture, wait for its check; return how many there were."""

        def posed() -> object:
            self.checks += 1
            return None

        self.watch.see(posed, 1, scene, frames)  # type: ignore[arg-type]
        self.watch.wait()
        return self.checks


def test_a_still_scene_is_checked_again_when_it_is_averaged_over_many_more_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watched = Watched(monkeypatch)
    counts = [watched.see(SceneState.STILL, frames) for frames in (1, 2, 3, 4, 5, 15, 16)]
    assert counts == [1, 1, 1, 2, 2, 2, 3]


def test_another_scene_is_checked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch)
    assert watched.see(SceneState.STILL, 8) == 1
    assert watched.see(SceneState.MOVING, 1) == 2
    assert watched.see(SceneState.STILL, 2) == 2


def test_what_a_check_found_is_told_without_another_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch, "it does not fit")
    assert not watched.watch.doubt
    watched.see(SceneState.STILL, 1)
    assert watched.watch.doubt == "it does not fit"
    assert watched.watch.advice == "advice"


def test_what_was_found_in_another_light_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch, "it does not fit")
    watched.see(SceneState.STILL, 8)
    assert watched.watch.doubt
    assert watched.watch.is_known
    watched.watch._not_before += 3600.0  # the check took long on a busy machine
    watched.watch.in_another_light()
    assert not watched.watch.doubt
    assert not watched.watch.is_known
    assert watched.see(SceneState.STILL, 8) == 2, "and looked at soon"


def test_nothing_is_checked_before_pictures_have_come_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch)
    monkeypatch.setattr(fit, "FIRST_S", 3600.0)
    watched.watch = CalibrationWatch()
    assert watched.see(SceneState.STILL, 1) == 0


def test_checks_take_a_tenth_of_the_time_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    watched, now_s = Watched(monkeypatch), [0.0]
    monkeypatch.setattr(fit, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr(fit, "_found", lambda *_: fit._Found("", "", 2.0))
    watched.watch = CalibrationWatch()
    counts = []
    for at_s in (0.1, 0.2, 18.1, 18.3, 18.4, 36.3, 36.5):  # what a check took is known when it is looked for
        now_s[0] = at_s
        counts.append(watched.see(SceneState.MOVING, 1))
    assert counts == [1, 1, 1, 2, 2, 2, 3]


def test_pictures_do_not_wait_for_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit, "FIRST_S", 0.0)
    pictures_go_on, found = threading.Event(), []

    def takes_long(*_: object) -> fit._Found:
        found.append(pictures_go_on.wait(20))
        return fit._Found("a doubt", "", 0.0)

    monkeypatch.setattr(fit, "_found", takes_long)
    watch, problem = CalibrationWatch(), SimpleNamespace()
    for _ in range(3):
        watch.see(lambda: problem, 1, SceneState.MOVING, 1)  # type: ignore[arg-type, return-value]
        assert watch.doubt == ""
    pictures_go_on.set()
    watch.wait()
    assert watch.doubt == "a doubt"
    assert found == [True]


@pytest.mark.parametrize("stray", [False, True])
@pytest.mark.parametrize("known", ["calibration", "PSF alone", "with a background"])
def test_stray_light_is_looked_for_where_a_photograph_would_have_a_background_for_it(
    known: str, stray: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked, judged, now_s = [], [], iter((5.0, 7.5))
    monkeypatch.setattr(fit, "time", SimpleNamespace(monotonic=lambda: next(now_s)))

    def with_background(problem: SimpleNamespace, calibration: object, *, restoring: bool) -> SimpleNamespace:
        assert not restoring  # other frames are solved as they come
        looked.append((problem.options.solver, calibration))
        return SimpleNamespace(smooth=stray)

    def check(problem: SimpleNamespace, **__: object) -> SimpleNamespace:
        judged.append(problem.smooth)
        return SimpleNamespace(sentences=("it does not fit.", "Nor does this."))

    monkeypatch.setattr(fit, "replace", lambda what, **new: SimpleNamespace(**{**vars(what), **new}))
    monkeypatch.setattr(fit, "reduced_calibration", lambda calibration, binning, planes: (binning, planes))
    monkeypatch.setattr(fit, "with_background", with_background)
    monkeypatch.setattr(fit, "check_calibration", check)
    posed: Any = SimpleNamespace(
        smooth=known == "with a background", options=SimpleNamespace(solver="admm-sensor")
    )
    calibration: Any = None if known == "PSF alone" else SimpleNamespace()
    found = fit._found(posed, calibration, 3, fit._Stage())
    asked = known == "calibration"
    assert looked == ([("auto", (3, None))] if asked else [])
    assert judged == [stray if asked else posed.smooth]
    assert ("--background" in found.advice) == (asked and stray)
    assert (found.doubt, found.seconds) == ("It does not fit.", 2.5)


def test_what_cannot_be_checked_is_said_and_what_fits_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    posed: Any = SimpleNamespace(smooth=False)
    monkeypatch.setattr(fit, "check_calibration", lambda _, **__: None)
    assert fit._found(posed, None, 1, fit._Stage()).doubt == ""
    monkeypatch.setattr(fit, "check_calibration", lambda _, **__: SimpleNamespace(sentences=()))
    assert fit._found(posed, None, 1, fit._Stage()).doubt == ""

    def breaks(_: object, **__: object) -> None:
        raise ArithmeticError("no light")

    monkeypatch.setattr(fit, "check_calibration", breaks)
    assert (
        fit._found(posed, None, 1, fit._Stage()).doubt
        == "Whether the calibration fits could not be found out: no light"
    )


def test_until_a_check_has_ended_it_is_said_what_is_looked_at_and_for_how_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s, asked, told = [0.0], threading.Event(), threading.Event()
    monkeypatch.setattr(fit, "time", SimpleNamespace(monotonic=lambda: now_s[0]))

    def check(_: Any, *, on_stage: Any) -> SimpleNamespace:
        on_stage(0.0, AMONG)
        now_s[0] += 2.0
        on_stage(0.25, "judging: so far its PSF explains the photograph better mirrored")
        asked.set()
        told.wait(20)
        return SimpleNamespace(sentences=("it does not fit",))

    monkeypatch.setattr(fit, "check_calibration", check)
    watch = CalibrationWatch()
    assert watch.awaited == f"{fit.NOT_JUDGED}: in a moment {fit.AT}"
    now_s[0] = fit.FIRST_S
    posed: Any = SimpleNamespace(smooth=False)
    watch.see(lambda: posed, 1, SceneState.STILL, 1)
    assert asked.wait(20)
    so_far = "so far its PSF explains the photograph better mirrored (looked at again)"
    assert watch.awaited == f"{fit.NOT_JUDGED}: {so_far}, some 10 s more"
    assert not watch.doubt, "it may be cleared"
    told.set()
    watch.wait()
    assert watch.awaited == ""
    assert watch.doubt == "It does not fit"
    watch.in_another_light()
    assert watch.awaited.startswith(fit.NOT_JUDGED)
