"""Holograms as jobs: computed, shown on the SLM, photographed."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.display.display_io import DisplayBench, bring_mask
from calibration_routines.display.hologram_photograph import Photographed, photograph_hologram, write_capture
from drivers.camera import Camera
from drivers.errors import DeviceError
from gui.jobs import JobCancelledError, JobContext
from gui.widgets.entry import existing_path
from instrument.bench.bench import Bench
from instrument.bench.config import BenchConfig
from instrument.bench.safety import StepsFailedError
from instrument.display.alignment import Alignment, load_alignment
from instrument.display.bench_display import bench_display
from instrument.display.hologram import (
    CaptureOptions,
    HologramResult,
    compute_and_judge,
    prepare_target,
    read_picture,
)
from instrument.display.hologram_files import HologramFiles, drawn_pattern
from instrument.display.hologram_forecast import forecast_hologram
from instrument.files.atomic import check_writable
from instrument.files.errors import BenchError
from instrument.files.results import free_result
from instrument.files.slm_image import load_slm_correction
from instrument.reconstruction.forecast import Forecast
from instrument.runs.run_control import EndedEarlyError, RunControl
from recon.arrays import Float32Array
from recon.base.as_python import Imports, expression
from recon.base.declare import option
from recon.holography import Display, HologramOptions, HologramRecord, Target

_FRAME_S = 0.02
"""How long each of several frames is shown before the next is sent; the SLM's settling comes on top."""


def plane_of(text: str) -> tuple[Path, float]:
    """Return a picture in another plane and its depth in mm, from ``FILE @ DEPTH mm``.

    Raises BenchError when it is not understood, or there is no such file.
    """
    name, at, depth = text.rpartition("@")
    bare = depth.strip().removesuffix("mm").strip()
    if not at or not bare:
        raise BenchError(f"{text!r}: write FILE @ DEPTH mm, e.g. far.png @ 40 mm.")
    try:
        z_mm = float(bare.replace(",", "."))
    except ValueError:
        raise BenchError(f"The depth {bare!r} is no number of mm.") from None
    if not math.isfinite(z_mm):
        raise BenchError(f"The depth must be a finite number of mm, not {bare}.")
    return existing_path(name.strip()), z_mm


def pattern_png(text: str) -> Path:
    """Return the name of a pattern; ValueError where it is none."""
    path = Path(text).expanduser()
    if path.suffix.lower() != ".png":
        raise ValueError("the pattern needs a name that ends in .png.")
    return path


@dataclass(frozen=True, slots=True, kw_only=True)
class HologramOrder:
    """A hologram of one picture: the files, the planes, and how it is computed."""

    picture: Path = option(help="The picture to show.", group="Picture")
    z_mm: float = option(0.0, help="Behind the focal plane.", unit="mm", label="Depth", group="Picture")
    further: tuple[tuple[Path, float], ...] = option(
        (),
        help="Pictures in other planes, each with its depth; several are separated by semicolons.",
        default_words="none (FILE @ 40 mm; …)",
        metavar="FILE @ DEPTH mm",
        parse=plane_of,
        label="Further planes",
        group="Picture",
    )
    alignment: Path | None = option(
        None,
        help="Of the mask, from align mask: alignment.json.",
        default_words="not aligned",
        group="Display",
    )
    out: Path = option(
        help="8-bit phase, 256 levels a turn; .json and a preview go beside it.",
        parse=pattern_png,
        label="Pattern",
        group="Result",
    )
    options: HologramOptions = field(default_factory=HologramOptions)

    def display(self, config: BenchConfig, size: tuple[tuple[int, int], float]) -> Display:
        """Return the display that it is computed for; errors as ``bench_display`` and ``load_alignment``."""
        options = self.options
        display = options.display_of(bench_display(config, size, expansion=options.expansion))
        return display if self.alignment is None else load_alignment(self.alignment).of(display)

    def targets(self, display: Display) -> list[Target]:
        """Return the picture of each plane as a target; errors as ``read_picture``."""
        return [
            prepare_target(read_picture(picture, self.options).pixels, display, self.options, z_mm=z_mm)
            for picture, z_mm in ((self.picture, self.z_mm), *self.further)
        ]

    def files(self, config: BenchConfig, display: Display) -> HologramFiles:
        """Return the files that are written."""
        return HologramFiles(self.out, config.display.slm_binning, self.options, [display])


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a hologram is: iterations so far, and how much of the budget is used up, 0 to 1."""

    share: float
    history: tuple[HologramRecord, ...]
    phase_rad: Float32Array


@dataclass(frozen=True, slots=True)
class Computed:
    """A hologram with what it was computed for, and its patterns' files (none of a preview).

    ``target`` is that of the plane in focus, on which the camera looks; where there is none, of the first.
    """

    order: HologramOrder
    display: Display
    target: Target
    result: HologramResult
    patterns: tuple[Path, ...]


def compute(
    order: HologramOrder,
    config: BenchConfig,
    size: tuple[tuple[int, int], float],
    context: JobContext,
    *,
    write: bool = True,
) -> Computed:
    """Compute a hologram as the command line does, and write its files."""
    display = order.display(config, size)
    files = order.files(config, display)
    if write:
        files.check(overwrite=False)
    targets = order.targets(display)
    options = order.options
    history: list[HologramRecord] = []

    def watch(record: HologramRecord, slm: Any) -> None:
        history.append(record)
        context.offer(lambda: so_far(record, slm))

    def so_far(record: HologramRecord, slm: Any) -> Progress:
        share = record.iteration / max(options.iterations, 1)
        if options.time_s is not None:
            share = max(share, record.seconds / options.time_s)
        drawn = drawn_pattern(np.asarray(slm).reshape(-1, *display.slm_shape)[0])
        return Progress(min(share, 1.0), tuple(history), drawn)

    result = compute_and_judge(display, targets, options, callback=watch, cancel=context.cancel)
    if write:
        files.write(0, 0, result)
    seen = next((target for target in targets if target.z_mm == 0), targets[0])
    return Computed(order, display, seen, result, tuple(files.patterns(0, 0)) if write else ())


def explain(
    order: HologramOrder, config: BenchConfig, size: tuple[tuple[int, int], float], context: JobContext
) -> Forecast:
    """Say what time and memory a hologram will take, by its first iterations; the share done is reported."""
    display = order.display(config, size)
    targets = order.targets(display)
    context.check()
    return forecast_hologram(display, targets, order.options, on_progress=context.report)


def show_on_slm(bench: Bench, computed: Computed, correction: Path | None, context: JobContext) -> None:
    """Show a hologram: one frame stays; several follow each other until the job is cancelled.

    Raises BenchError where it was computed for a display learned with another SLM calibration, or with none.
    """
    _aligned(computed, correction)
    io = _display_bench(bench, correction)
    frames = computed.result.hologram.slm
    io.show(frames[0])
    number = 0
    while len(frames) > 1 and not context.cancel.wait(_FRAME_S):
        number = (number + 1) % len(frames)
        io.show(frames[number])


def photograph(
    bench: Bench,
    computed: Computed,
    correction: Path | None,
    average: int,
    context: JobContext,
) -> tuple[Photographed, Path]:
    """Show a hologram, photograph it, compare it with its target, and write what was seen.

    Ends at once when it is cancelled; the bench is safe afterwards, however it ends, and the
    camera's exposure as it was. Raises BenchError as :func:`show_on_slm`.
    """
    place = _aligned(computed, correction)
    pattern = computed.order.out
    out = free_result(pattern.parent, f"{pattern.stem}-seen", ".png")
    check_writable(out)  # before the bench is touched
    control = RunControl()

    def stop() -> None:
        with contextlib.suppress(StepsFailedError):  # STOP says so, and the procedure's own end
            control.stop()

    def cancel() -> None:
        control.abort()  # from now on no further frame; a move or an exposure is ended by the thread
        threading.Thread(target=stop, name="STOP", daemon=True).start()

    context.on_cancel(cancel)
    try:
        with _exposure_kept(bench.camera), control.procedure(bench):
            if place is not None:
                bring_mask(bench, place.stage_position)
            seen = photograph_hologram(
                _display_bench(bench, correction, control.check),
                list(computed.result.hologram.slm),
                computed.display,
                computed.target,
                CaptureOptions(average=average),
                computed=computed.order.options,
            )
            bench.stop()
    except EndedEarlyError as error:
        raise JobCancelledError from error
    write_capture(out, seen)
    return seen, out


@contextlib.contextmanager
def _exposure_kept(camera: Camera) -> Iterator[None]:
    before_ms = camera.exposure_ms
    try:
        yield
    except BaseException:
        with contextlib.suppress(DeviceError):  # the error that ended it is the one to be shown
            camera.set_exposure_ms(before_ms)
        raise
    camera.set_exposure_ms(before_ms)


def _aligned(computed: Computed, correction: Path | None) -> Alignment | None:
    """Return the alignment that a hologram was computed for, if any, which must fit the SLM calibration."""
    if computed.order.alignment is None:
        return None
    place = load_alignment(computed.order.alignment)
    place.require_correction(correction is not None)
    return place


def _display_bench(
    bench: Bench, correction: Path | None, check: Callable[[], object] = lambda: None
) -> DisplayBench:
    loaded = None if correction is None else load_slm_correction(correction)
    return DisplayBench(bench, bench.config.display.slm_binning, loaded, check=check)


def compute_lines(order: HologramOrder, config: BenchConfig, weights: str | None) -> str:
    """Return the Python that computes and writes a hologram.

    ``weights`` is the expression that makes the weights; None where there are none.
    """
    hologram = ("compute_and_judge", "prepare_target", "read_picture")
    imports = Imports({("instrument.display.hologram", name) for name in hologram})
    imports.names |= {
        ("instrument.display.bench_display", "bench_display"),
        ("instrument.display.bench_display", "slm_size"),
        ("instrument.bench.config_file", "load_config"),
        ("instrument.display.hologram_files", "HologramFiles"),
    }
    options = expression(replace(order.options, weights=None), imports)
    if weights is not None:
        imports.names |= {("dataclasses", "replace"), ("recon.holography", weights.partition("(")[0])}
        options = f"replace({options}, weights={weights})"
    lines = [
        f"config = load_config({'None' if config.path is None else expression(config.path, imports)})",
        f"options = {options}",
        "display = options.display_of(bench_display(config, slm_size(config), expansion=options.expansion))",
    ]
    if order.alignment is not None:
        imports.names.add(("instrument.display.alignment", "load_alignment"))
        lines.append(f"display = load_alignment({expression(order.alignment, imports)}).of(display)")
    lines += [
        f"planes = {expression([(order.picture, order.z_mm), *order.further], imports)}",
        "targets = [",
        "    prepare_target(read_picture(picture, options).pixels, display, options, z_mm=z_mm)",
        "    for picture, z_mm in planes",
        "]",
        "result = compute_and_judge(display, targets, options)",
        f"out = {expression(order.out, imports)}",
        "files = HologramFiles(out, config.display.slm_binning, options, [display])",
        "files.write(0, 0, result)",
    ]
    return "\n".join([*imports.lines(), "", *lines, ""])
