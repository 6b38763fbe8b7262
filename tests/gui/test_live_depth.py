"""When the live reconstruction looks for the scene's depth: with the first light, and for each new doubt."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from gui.live_depth import DepthSeeker


class Signal:
    def __init__(self) -> None:
        self.calls: list[Callable[..., object]] = []

    def connect(self, call: Callable[..., object]) -> None:
        self.calls.append(call)

    def emit(self, *values: object) -> None:
        for call in self.calls:
            call(*values)


class Seen:
    """A seeker, what it began, and pictures for it."""

    def __init__(self) -> None:
        self.jobs: list[Any] = []
        self.found: list[float] = []
        self.z_um = 1e5
        session: Any = SimpleNamespace(
            live=SimpleNamespace(newest=lambda: SimpleNamespace(image=np.ones((4, 4)))),
            lights=SimpleNamespace(during=lambda _: "scene"),
            jobs=SimpleNamespace(exclusive_job=None, watch=self._watch),
            log=lambda *_: None,
        )
        self.seeker = DepthSeeker(session, self.found.append)

    def _watch(self, _title: str, _work: object) -> Any:
        self.jobs.append(SimpleNamespace(succeeded=Signal(), ended=Signal()))
        return self.jobs[-1]

    def see(self, doubt: str) -> None:
        result: Any = SimpleNamespace(picture=SimpleNamespace(doubt=doubt), metadata=None)
        reconstructor: Any = SimpleNamespace(options=SimpleNamespace(z_um=self.z_um))
        self.seeker.see(result, reconstructor)

    def end(self, z_um: float) -> None:
        self.jobs[-1].succeeded.emit(z_um)
        self.jobs[-1].ended.emit()


def test_a_doubt_whose_numbers_change_is_looked_into_once_and_again_after_another_depth_was_found() -> None:
    seen = Seen()
    seen.see("")
    seen.end(1e5)
    for larger in (9.4, 9.3, 8.7):
        seen.see(f"Its PSF explains it better {larger} % larger")
        seen.see(f"Its PSF explains it better {larger} % smaller")
        seen.end(1e5)
    assert len(seen.jobs) == 3
    seen.see("Another")
    assert len(seen.jobs) == 4
    seen.end(2e5)
    assert seen.found == [2e5]
    seen.see("Another")  # of the preview of before
    seen.z_um = 2e5
    seen.see("")
    assert len(seen.jobs) == 4
    seen.see("Another")
    assert len(seen.jobs) == 5


def test_a_doubt_that_was_shown_stays_while_it_is_looked_into() -> None:
    seen = Seen()
    seen.see("Its PSF explains it better 9.4 % larger")
    assert seen.seeker.words, "nobody has seen the doubt yet"
    seen.see("Dust")
    seen.end(1e5)
    seen.see("Dust")
    assert len(seen.jobs) == 2
    assert not seen.seeker.words
