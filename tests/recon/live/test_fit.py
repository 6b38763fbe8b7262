"""When live pictures are checked against their calibration, without a picture."""

from __future__ import annotations

import pytest

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


def test_nothing_is_checked_before_pictures_have_come_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch)
    monkeypatch.setattr(fit, "FIRST_S", 3600.0)
    watched.watch = CalibrationWatch()
    assert watched.see(SceneState.STILL, 1) == 0
