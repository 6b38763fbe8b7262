"""What ``hologram`` computes beside pictures: holograms of spots, and the limit of what is possible."""

from __future__ import annotations

from pathlib import Path

import typer

from instrument.bench.config import BenchConfig
from instrument.cli.progress import first_interrupt_cancels, one_task
from instrument.display.hologram import bench_display, load_alignment
from instrument.display.hologram_files import HologramFiles
from instrument.display.limit import lifts_of, limit_lines, limits_of_lifts
from instrument.display.spots import SpotFiles, spots_of
from instrument.files.images import Pixels
from instrument.tasks.task import saying_what_is_left
from recon.holography import Display, HologramOptions, HologramRecord, HologramStop, compute_spots


def say_limit(picture: Pixels, display: Display, options: HologramOptions, z_mm: float) -> None:
    """Say what could be reached, which frequencies fall short, and what would help."""
    lifts = lifts_of(options)
    with first_interrupt_cancels() as cancel, one_task("limit", options.iterations * len(lifts)) as advance:

        def show(lift: float, record: HologramRecord) -> None:
            before = lifts.index(lift) * options.iterations
            black = "" if lift == options.lift else f"black at {lift:g}: "
            advance(float(before + record.iteration), note=f"{black}{record.psnr_db:.2f} dB")

        found = limits_of_lifts(picture, display, options, z_mm=z_mm, callback=show, cancel=cancel)
    if found[-1].stop_reason is HologramStop.CANCELLED:
        typer.echo("Interrupted: this is a bound all the same, less sharp than it could be.", err=True)
    for line in limit_lines(found, display, options):
        typer.echo(line)


def say_spots(
    asked: str,
    out: Path,
    options: HologramOptions,
    bench: tuple[BenchConfig, tuple[tuple[int, int], float], Path | None],
    *,
    overwrite: bool,
) -> None:
    """Compute a hologram of spots, say how even they are, write.

    ``bench`` is the configuration, its SLM's shape and pitch, and the mask's alignment where there is one.
    """
    config, size, alignment = bench
    spots = spots_of(asked)
    display = options.display_of(bench_display(config, size, expansion=options.expansion))
    if alignment is not None:
        display = load_alignment(alignment).of(display)
    writer = HologramFiles(out, config.display.slm_binning, options, [display])
    writer.check(overwrite=overwrite)
    with saying_what_is_left(*writer.files()), first_interrupt_cancels() as cancel:
        with one_task("spots", options.iterations) as advance:

            def show(record: HologramRecord, _slm: object) -> None:
                advance(float(record.iteration), note=f"deviation {record.loss:.2%}")

            found, scores = compute_spots(display, spots, options, callback=show, cancel=cancel)
        SpotFiles(writer).write(spots, found, scores)
    last = found.history[-1]
    typer.echo(f"spots: {last.iteration} iterations, {found.seconds:.1f} s: {found.stop_reason}")
    least, greatest = scores.relative.min(), scores.relative.max()
    typer.echo(
        f"  {len(spots)} spots: {least:.3f} to {greatest:.3f} of the brightness asked for, "
        f"deviation {scores.deviation:.2%} (computed)"
    )
    typer.echo(f"  light: {scores.efficiency:.1%} of what falls on the SLM is in the spots")
    if found.stop_reason is HologramStop.CANCELLED:
        typer.echo("Interrupted: this is the pattern so far.", err=True)
        raise typer.Exit(130)
