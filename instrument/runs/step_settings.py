"""Bring the bench to a step's settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from drivers.led_array import LedPattern
from instrument.bench.bench import Bench
from instrument.files.errors import BenchError
from instrument.files.slm_image import read_slm_levels
from instrument.plan import Light, SourcePosition, Step


class StepSettings:
    """Brings the bench to a step's settings, touching only what differs from the step before."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._light: Light | None = None
        self._scene_lit: bool | None = None
        self._slm_image: Path | None = None
        self._exposure_ms: float | None = None
        self._gain: float | None = None
        self._source_um: SourcePosition | None = None
        self._stage: Mapping[str, float] = {}

    def actions(self, step: Step) -> list[Callable[[], object]]:
        """Return what to do, in order: camera, motion, SLM, light."""
        actions: list[Callable[[], object]] = []
        if (exposure_ms := step.exposure_ms) is not None and exposure_ms != self._exposure_ms:
            actions.append(lambda: self._set_exposure(exposure_ms))
        if (gain := step.gain) is not None and gain != self._gain:
            actions.append(lambda: self._set_gain(gain))
        if (source_um := step.source_um) is not None and source_um != self._source_um:
            actions.append(lambda: self._place_source(source_um))
        if step.stage and step.stage != self._stage:
            actions.append(lambda: self._move_stage(step))
        if (slm_image := step.slm_image) is not None and slm_image != self._slm_image:
            actions.append(lambda: self._display(slm_image))
        if step.scene_lit != self._scene_lit:
            actions.append(lambda: self._set_scene(step.scene_lit))
        if step.light != self._light:
            actions.append(lambda: self._set_light(step.light))
        return actions

    def darken(self) -> None:
        """Turn off the light for a pause; the next step turns it on again."""
        if self._light is not None and self._light.kind != "off":
            self._bench.source_off()
            self._light = None

    def _set_exposure(self, exposure_ms: float) -> None:
        self._bench.camera.set_exposure_ms(exposure_ms)
        self._exposure_ms = exposure_ms

    def _set_gain(self, gain: float) -> None:
        self._bench.camera.set_gain(gain)
        self._gain = gain

    def _place_source(self, source_um: SourcePosition) -> None:
        self._source_um, self._stage = None, {}
        self._bench.place_source(*source_um)
        self._source_um = source_um

    def _move_stage(self, step: Step) -> None:
        if self._bench.stage is None:
            raise BenchError(f"{step} wants a stage, and this bench has none.")
        self._source_um, self._stage = None, {}
        self._bench.stage.move_to(step.stage)
        self._stage = step.stage

    def _display(self, path: Path) -> None:
        slm = self._bench.slm
        if slm is None:
            raise BenchError(f"SLM image {path}: this bench has no SLM.")
        slm.display(read_slm_levels(path))
        self._slm_image = path

    def _set_scene(self, lit: bool) -> None:
        if lit:
            self._bench.scene_on()
        else:
            self._bench.scene_off()
        self._scene_lit = lit

    def _set_light(self, light: Light) -> None:
        self._light = None
        if light.kind == "source":
            self._bench.source_on()
        elif light.kind == "off":
            self._bench.source_off()
        else:
            self._show(light.pattern())
        self._light = light

    def _show(self, pattern: LedPattern) -> None:
        if self._bench.led_array is None:
            raise BenchError(f"light {pattern.description}: this bench has no LED array.")
        self._bench.led_array.set_pattern(pattern)
