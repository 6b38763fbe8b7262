"""What was lit while a frame was exposed: frames of a live view know it only from when the light changed."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from drivers.frame import FrameMetadata
from instrument.bench.bench import Bench
from instrument.bench.lit import LightState, led_pattern, light_of

NOTHING_LIT = "nothing lit"
_KEPT = 200
_LAG_NS = 30_000_000
"""From the end of an exposure to the frame's arrival at the host, and from a change to its note, at most."""


def light_words(bench: Bench) -> str:
    """Return what is lit now, as far as the program knows, in a few words."""
    light, pattern = light_of(bench), led_pattern(bench)
    slm = bench.slm
    if slm is not None and slm.is_screen and light is LightState.DARK and slm.displayed.any():
        return "screen"
    if light is LightState.DARK and not bench.knows_scene:
        return "not known" if pattern is None else "LEDs dark, scene not known"
    if light is not LightState.AS_IS:
        return {LightState.SCENE: "scene", LightState.SOURCE: "point source"}.get(light, NOTHING_LIT)
    words = f"LEDs: {pattern.description}" if pattern is not None and not pattern.is_dark else ""
    return " and ".join(filter(None, ("scene" if bench.scene_lit else "", words)))


class LightLog:
    """Notes what is lit whenever it is asked to, and tells what was lit during a frame.

    Parameters
    ----------
    words : callable
        Returns what is lit now; must not talk to a device.
    """

    def __init__(self, words: Callable[[], str]) -> None:
        self._words = words
        self._changes: deque[tuple[int, str]] = deque(maxlen=_KEPT)
        """When something else was lit (``time.monotonic_ns()``), and what."""

    def note(self) -> None:
        """Look what is lit; to be called often, from one thread."""
        words = self._words()
        if not self._changes or self._changes[-1][1] != words:
            self._changes.append((time.monotonic_ns(), words))

    def during(self, frame: FrameMetadata) -> str:
        """Return what was lit while a frame was exposed; of a change meanwhile, both. From any thread.

        Empty where it is not known any more.
        """
        end_ns = frame.host_time_ns
        start_ns = end_ns - int(frame.exposure_ms * 1e6) - _LAG_NS
        changes = list(self._changes)
        before = [words for at_ns, words in changes if at_ns <= start_ns]
        within = [words for at_ns, words in changes if start_ns < at_ns <= end_ns]
        if not before and len(within) < 2:
            return within[0] if within else ""
        return ", then ".join([*before[-1:], *within])
