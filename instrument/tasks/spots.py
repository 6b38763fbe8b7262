"""What is computed for a display beside pictures: holograms of spots, and the limit of what is possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from instrument.bench.config import BenchConfig
from instrument.display.alignment import load_alignment
from instrument.display.bench_display import bench_display, slm_size
from instrument.display.hologram import field_words, prepare_target, read_picture
from instrument.display.hologram_files import HologramFiles
from instrument.display.limit import (
    SharedTime,
    at_most,
    coarser_mask,
    frames_line,
    is_told,
    lifts_of,
    limit_lines,
    limits_of_lifts,
)
from instrument.display.spots import SpotFiles, middle_line, spots_of
from instrument.files.errors import BenchError
from instrument.files.pictures import Pixels
from instrument.tasks.task import BenchFile, Desk, Done, Only, bench_of, saying_what_is_left, task
from recon.base.declare import option
from recon.holography import (
    Display,
    HologramOptions,
    HologramRecord,
    HologramStop,
    compute_spots,
    hologram_limit,
)
from recon.holography.limit import gain_of_frames

_OF_PICTURES = ("picture",)


@dataclass(frozen=True, kw_only=True)
class HologramInputs:
    """What is shown, for which display, and where the pattern goes."""

    spots: str | None = option(
        None,
        help="Spots instead of a picture: an even array, 10x10, or a CSV file with columns y, x (fractions "
        "of the field from the top left), and where wanted intensity, z_mm.",
        metavar="ROWSxCOLUMNS|FILE",
        group="Files",
        applies=("spots",),
    )
    limit: bool = option(
        False,
        help="Compute no pattern: say what any number of frames could reach for this picture, mask and SLM.",
        group="What counts",
        applies=("limit",),
    )
    explain: bool = option(
        False,
        help="Compute no pattern: only say what time and memory it takes.",
        group="Files",
        applies=_OF_PICTURES,
    )
    z_mm: tuple[float, ...] = option(
        (),
        help="Depth of each target behind the focal plane; once a target.",
        label="Depth",
        default_words="0",
        unit="mm",
        group="Files",
        applies=("picture", "limit"),
    )
    video: bool = option(
        False,
        help="TARGET is a folder or stack; each frame starts from the last.",
        group="Files",
        applies=_OF_PICTURES,
    )
    color: bool = option(
        False, help="Field-sequential colour: one pattern a channel.", group="Files", applies=_OF_PICTURES
    )
    wavelengths: tuple[float, float, float] = option(
        (638.0, 520.0, 450.0),
        help="With --color, nm.",
        above=0,
        metavar="R G B",
        group="Files",
        applies=_OF_PICTURES,
    )
    weights: Path | None = option(
        None, help="A weight image instead of the fovea.", group="What counts", applies=_OF_PICTURES
    )
    alignment: Path | None = option(None, help="From align mask.", group="Display")
    out: Path = option(
        Path("slm.png"),
        help="8-bit phase, 256 levels a turn (--complex: .npy); .json and a preview.",
        flags=("--out", "-o"),
        label="Result",
        group="Files",
    )
    force: bool = option(False, help="Overwrite files that exist.", label="Overwrite", group="Files")

    def depths(self, count: int) -> list[float]:
        """Return the depth of each of ``count`` targets; BenchError where they do not fit."""
        depths = list(self.z_mm) or [0.0] * count
        if len(depths) != count or (count > 1 and not self.z_mm):
            raise BenchError(f"Give --z-mm once for each of the {count} targets (found {len(self.z_mm)}).")
        return depths


@dataclass(frozen=True, kw_only=True)
class LimitTarget:
    """What is to be shown."""

    target: Path = option(
        help="The picture.", metavar="TARGET", label="Picture", positional=True, group="Files"
    )


@task(subject="limit")
def limit(
    desk: Desk,
    picture: LimitTarget,
    inputs: Annotated[HologramInputs, Only("z_mm", "alignment")],
    options: HologramOptions,
    bench: BenchFile,
) -> Done:
    """Say what any number of frames could reach for a picture, the bench's mask and SLM."""
    config = bench_of(desk, bench)
    display = options.display_of(bench_display(config, slm_size(config), expansion=options.expansion))
    if inputs.alignment is not None:
        display = load_alignment(inputs.alignment).of(display)
    pixels = read_picture(picture.target, options).pixels
    if said := field_words(pixels, options.fit):
        desk.warn(said)
    return tell_limit(desk, pixels, display, options, inputs.depths(1)[0])


@task(subject="spots", needed=("spots",))
def spots(
    desk: Desk,
    inputs: Annotated[HologramInputs, Only("spots", "out", "alignment", "force")],
    options: HologramOptions,
    bench: BenchFile,
) -> Done:
    """Compute the SLM phase that makes spots as bright as asked for, at any places and depths."""
    config = bench_of(desk, bench)
    return make_spots(desk, inputs, options, (config, slm_size(config, spots=True)))


def tell_limit(desk: Desk, picture: Pixels, display: Display, options: HologramOptions, z_mm: float) -> Done:
    """Tell what could be reached, which frequencies fall short, and what would help."""
    lifts = lifts_of(options)
    steps = options.iterations * len(lifts)
    with desk.interruptible() as cancel, desk.step("limit", steps) as advance:

        def show(lift: float, record: HologramRecord) -> None:
            before = lifts.index(lift) * options.iterations
            black = "" if lift == options.lift else f"black at {lift:g}: "
            advance(float(before + record.iteration), note=f"{black}{record.psnr_db:.2f} dB")

        coarser = coarser_mask(display)
        shared = SharedTime(options, len(lifts) + (coarser is not None))
        found = limits_of_lifts(
            picture, display, options, shared=shared, z_mm=z_mm, callback=show, cancel=cancel
        )
        lines = limit_lines(found, display, options)
        if not cancel.is_set():
            target = prepare_target(picture, display, options, z_mm=z_mm)
            lines.append(frames_line(gain_of_frames(display, [target], options)))
        if coarser is not None and not cancel.is_set():
            target = prepare_target(picture, coarser, options, z_mm=z_mm)
            better = at_most(hologram_limit(coarser, target, shared.next(options), cancel=cancel))
            lines.append(f"  half of the field, along each axis (--expansion {coarser.expansion}): {better}")
    if cancel.is_set():
        sharp = (
            "this is a bound all the same, less sharp than it could be"
            if is_told(found[0])
            else "no bound yet"
        )
        desk.warn(f"Interrupted: {sharp}.")
    for line in filter(None, lines):
        desk.say(line)
    return Done()


def say_distance(desk: Desk, displays: Sequence[Display], options: HologramOptions) -> None:
    """Say how wide a picture without a lens is, and how it is computed."""
    if options.distance_mm is None:
        return
    behind = "mask" if displays[0].factor > 1 else "SLM"
    how = f", as the {behind} is (near: by its angular spectrum)" if displays[0].near else ""
    width_mm = min(display.picture_mm for display in displays)
    desk.warn(
        f"Without a lens: the picture's field is {width_mm:.4g} mm wide{how}, {options.distance_mm:g} mm "
        f"behind the {behind}."
    )


def make_spots(
    desk: Desk,
    inputs: HologramInputs,
    options: HologramOptions,
    bench: tuple[BenchConfig, tuple[tuple[int, int], float]],
) -> Done:
    """Compute a hologram of spots, tell how even they are, write.

    ``bench`` is the configuration, and its SLM's shape and pitch. Raises BenchError where no spots are named.
    """
    if inputs.spots is None:
        raise BenchError("--spots must be given.")
    config, size = bench
    wanted = spots_of(inputs.spots)
    display = options.display_of(bench_display(config, size, expansion=options.expansion))
    say_distance(desk, [display], options)
    if inputs.alignment is not None:
        display = load_alignment(inputs.alignment).of(display)
    writer = HologramFiles(inputs.out, config.display.slm_binning, options, [display])
    writer.check(overwrite=inputs.force)
    with saying_what_is_left(*writer.files()), desk.interruptible() as cancel:
        with desk.step("spots", options.iterations) as advance:

            def show(record: HologramRecord, _slm: object) -> None:
                advance(float(record.iteration), note=f"deviation {record.loss:.2%}")

            found, scores = compute_spots(display, wanted, options, callback=show, cancel=cancel)
        SpotFiles(writer).write(wanted, found, scores)
    last = found.history[-1]
    desk.say(f"spots: {last.iteration} iterations, {found.seconds:.1f} s: {found.stop_reason}")
    least, greatest = scores.relative.min(), scores.relative.max()
    desk.say(
        f"  {len(wanted)} spots: {least:.3f} to {greatest:.3f} of the brightness asked for, "
        f"deviation {scores.deviation:.2%} (computed)"
    )
    desk.say(f"  light: {scores.efficiency:.1%} of what falls on the SLM is in the spots")
    if middle := middle_line(display, wanted, scores):
        desk.say(middle)
    cancelled = found.stop_reason is HologramStop.CANCELLED
    kept = "Interrupted: this is the pattern so far." if cancelled else ""
    return Done(tuple(file for file in writer.files() if file.exists()), kept=kept)
