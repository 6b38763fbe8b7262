"""``diffuserbench show``: what is in a run; or put a hologram on the SLM, and photograph it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from instrument.bench.photograph import SPOILT
from instrument.cli.app import App, BenchOption, examples, naming_as_is, open_and_say
from instrument.cli.progress import one_task
from instrument.display.hologram import HOLOGRAM, PHOTOGRAPHED, CaptureOptions
from instrument.files.atomic import require_new
from instrument.files.errors import BenchError, FileError, percent
from instrument.tasks.task import Given, saying_what_is_left
from recon.base.declare import option

if TYPE_CHECKING:
    from calibration_routines.display.colour_photograph import ColourPattern
    from calibration_routines.display.display_io import DisplayBench
    from instrument.display.alignment import Alignment
    from instrument.runs.run import Run

app = App()

PICTURES = (".png", ".tif", ".tiff", ".npy", ".bmp")
_PATTERN, _SHOWN = (HOLOGRAM,), "Shown on the SLM"


@dataclass(frozen=True, kw_only=True)
class _Shown:
    """How a hologram is shown."""

    slm_calibration: Path | None = option(None, help="From calibrate slm.", applies=_PATTERN, group=_SHOWN)
    alignment: Path | None = option(
        None,
        help="From align mask: bring the mask's stage to where it left it.",
        applies=_PATTERN,
        group=_SHOWN,
    )
    seconds: float | None = option(
        None,
        help="How long.",
        default_words="until Enter or Ctrl-C",
        unit="s",
        least=0,
        flags=("--seconds",),
        applies=_PATTERN,
        group=_SHOWN,
    )
    capture: Path | None = option(
        None, help="Photograph it (PNG) and end.", applies=_PATTERN, group=PHOTOGRAPHED
    )
    target: Path | None = option(None, help="The picture wanted.", applies=_PATTERN, group=PHOTOGRAPHED)


@dataclass(frozen=True, kw_only=True)
class ShowOptions(CaptureOptions, _Shown):
    """How a hologram is shown and photographed, or where the picture of a run goes."""

    as_is: bool = option(
        False,
        help="Ask nobody; the laser stays on, and the background is estimated.",
        applies=_PATTERN,
        group=PHOTOGRAPHED,
    )
    force: bool = option(False, help="Overwrite files that exist.", applies=_PATTERN, group=PHOTOGRAPHED)
    picture: Path | None = option(
        None,
        help="Where its picture goes (PNG).",
        default_words="summary.png in its folder",
        flags=("--picture", "-p"),
        applies=("run",),
        group="Of a run",
    )

    def check(self, n_patterns: int, *, spots: bool) -> None:
        """Refuse what does not go together for pictures or spots, or a file that exists.

        Raises BenchError or FileError.
        """
        capture = self.capture
        if spots and self.target is not None:
            raise BenchError("Spots are compared with what was asked for: leave --target out.")
        if not spots and (capture is None) != (self.target is None):
            raise BenchError("Give --capture FILE and --target FILE together.")
        if capture is not None:
            require_new(capture, overwrite=self.force)
            if capture.suffix.lower() != ".png":
                raise FileError(capture, "a capture is written as .png.")
        if self.as_is and capture is None:
            raise BenchError("--as-is goes with --capture: without it no light is switched and nobody asked.")
        if self.refine and (capture is None or n_patterns > 1):
            raise BenchError("--refine needs --capture, and one pattern.")


@app.command(
    epilog=examples(
        "diffuserbench show runs/2026-11-21_14-03-22_axial-sweep",
        "diffuserbench show slm.png --bench display.toml --seconds 60",
        "diffuserbench show slm.png --bench display.toml --capture seen.png --target picture.png",
        "diffuserbench show spots.png --bench display.toml --capture seen.png --refine 4",
        "diffuserbench show slm-frame1.png slm-frame2.png --capture seen.png --target picture.png",
        "diffuserbench show slm-red.png slm-green.png slm-blue.png --capture seen.png --target colour.png",
    )
)
def show(
    what: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN|PATTERN...",
            help="A run's folder; or an 8-bit phase picture from hologram (several: frames, colours).",
        ),
    ],
    options: ShowOptions,
    given: Given,
    bench: BenchOption = None,
) -> None:
    """Say how a run ended and what it holds, with a picture; or show a hologram on the SLM.

    A hologram's look-up table and flatness are applied here, once. Without --capture the light is yours.

    With --capture the camera is registered by the mask's own speckle, the hologram photographed, brought to
    the field of view, low-passed as an eye would, and compared with --target: PSNR and SSIM.
    """
    if len(what) == 1 and what[0].suffix.lower() not in PICTURES:
        given.refuse("a run", "run")
        _show_run(what[0], options.picture)
        return
    given.refuse("a hologram", "hologram")
    _show_hologram(what, options, bench)


def _show_hologram(what: list[Path], options: ShowOptions, bench: Path | None) -> None:
    """Put patterns on the SLM; hold them, or photograph what they show."""
    from calibration_routines.display.colour_photograph import colour_patterns
    from calibration_routines.display.display_io import DisplayBench, bring_mask
    from instrument.display.alignment import load_alignment
    from instrument.files.slm_image import (
        is_of_mirrors,
        levels_field,
        load_slm_correction,
        mismatch,
        read_slm_image,
    )

    read = [read_slm_image(path) for path in what]
    spots = "spots" in read[0][1]
    options.check(len(what), spots=spots)
    if spots and len({facts.get("wavelength_nm") for _, facts in read}) > 1:
        raise BenchError("Spots are shown and photographed in one light; these patterns are for several.")
    correction = load_slm_correction(options.slm_calibration) if options.slm_calibration else None
    place = load_alignment(options.alignment) if options.alignment else None
    if place is not None:
        place.require_correction(correction is not None)
    with naming_as_is(), open_and_say(bench, as_is=options.as_is) as opened:
        if opened.slm is None:
            raise BenchError(f"{opened.label} has no [slm].")
        for path, (levels, facts) in zip(what, read, strict=True):
            if levels.shape != opened.slm.shape:
                sizes = (" x ".join(map(str, shape)) for shape in (levels.shape, opened.slm.shape))
                raise FileError(
                    path,
                    "has {} pixels, the SLM {}.".format(*sizes),
                    f"A picture becomes a hologram by: diffuserbench hologram {quote(str(path))}",
                )
            if facts and (words := mismatch(opened.slm, mirrors=is_of_mirrors(facts))):
                raise FileError(path, f"cannot be shown: {words}")
        bring_mask(opened, place.stage_position if place else {})
        binning, own_nm = opened.config.display.slm_binning, opened.config.display.wavelength_nm
        fields = [levels_field(levels, binning, mirrors=opened.slm.mirrors) for levels, _ in read]
        colours = colour_patterns(fields, [facts for _, facts in read], own_nm)
        lights = [
            DisplayBench(
                opened,
                binning,
                correction,
                estimate_background=options.as_is,
                wavelength_nm=colour.wavelength_nm,
            )
            for colour in colours
        ]
        if options.capture is None:
            _hold(lights, colours, options.seconds)
        elif len(colours) > 1:
            _capture_colours(lights, colours, options, place)
        elif spots:
            _capture_spots(lights[0], fields, read[0][1], what[0], options, place)
        else:
            _capture(lights[0], fields, read[0][1], what[0], options, place)


def _hold(lights: list[DisplayBench], colours: list[ColourPattern], seconds: float | None) -> None:
    """Show one pattern, or several in turn, each colour in its own light."""
    shown = [(io, field) for io, colour in zip(lights, colours, strict=True) for field in colour.fields]
    io, field = shown[0]
    io.show(field)
    lit = not all(io.own_light for io in lights)
    if lit:
        io.light(on=True)
    typer.echo(f"Shown on {io.slm.name}: {io.bench.label}", err=True)
    end = time.monotonic() + (seconds if seconds is not None else float("inf"))
    number = 0
    try:
        if seconds is None and len(shown) == 1:
            typer.echo("Press Enter to end.", err=True)
            input()
            return
        while time.monotonic() < end:
            number = (number + 1) % len(shown)
            if len(shown) > 1:
                if lit:
                    io.light(on=False)
                io, field = shown[number]
                io.show(field)
                if lit:
                    io.light(on=True)
            time.sleep(min(0.02, max(end - time.monotonic(), 0)))
    finally:
        if lit:
            io.light(on=False)


def _capture_colours(
    lights: list[DisplayBench], colours: list[ColourPattern], options: ShowOptions, place: Alignment | None
) -> None:
    """Photograph one colour after the other, say how good the picture is, write."""
    from calibration_routines.display.colour_photograph import photograph_colours, write_colours
    from instrument.display.hologram import read_picture

    assert options.capture is not None
    assert options.target is not None
    picture = read_picture(options.target).pixels
    found = photograph_colours(lights, colours, picture, place, average=options.average)
    write_colours(options.capture, found)
    mark = " (SIMULATED)" if found.simulated else ""
    for nm, score in zip(found.wavelengths_nm, found.channels, strict=True):
        typer.echo(f"  {nm:g} nm: {score.psnr_db:.2f} dB, SSIM {score.ssim:.3f}")
    typer.echo(f"photographed in colour: {found.psnr_db:.2f} dB, SSIM {found.ssim:.3f}{mark}")
    typer.echo("  each colour brought to the brightness wanted of it, as the lasers' powers are set")
    _warn_of_saturation(found.saturated_fraction)
    typer.echo(f"Wrote {options.capture}")


def _end_early(ended_by: BaseException | None) -> None:
    if ended_by is not None:
        ended_by.add_note("This is the best pattern so far.")
        raise ended_by


def _warn_of_saturation(fraction: float) -> None:
    if fraction > SPOILT:
        typer.echo(f"Warning: {percent(fraction)} of the camera's pixels are saturated.", err=True)


def _capture(
    io: DisplayBench,
    fields: list[Any],
    facts: dict[str, Any],
    pattern: Path,
    options: ShowOptions,
    place: Alignment | None,
) -> None:
    """Photograph, say how good it is, write."""
    from calibration_routines.display.hologram_photograph import (
        display_of_pattern,
        options_of_pattern,
        photograph_hologram,
        refined_path,
        require_focus,
        target_of_pattern,
        write_capture,
        write_refined,
    )
    from instrument.display.hologram import read_picture
    from instrument.display.hologram_files import score_words

    assert options.capture is not None
    assert options.target is not None
    opened = io.bench
    assert opened.slm is not None
    slm = opened.slm.shape, opened.slm.pixel_pitch_um
    display = display_of_pattern(opened.config, slm, facts, place)
    require_focus(facts.get("z_mm", [0.0]), refined=options.refine > 0)
    computed = options_of_pattern(facts)
    written = (refined_path(pattern), options.capture) if options.refine else (options.capture,)
    with saying_what_is_left(*written):
        found = photograph_hologram(
            io,
            fields,
            display,
            target_of_pattern(read_picture(options.target, computed).pixels, display, facts),
            options,
            progress=lambda n, psnr: typer.echo(f"round {n}: {psnr:.2f} dB", err=True),
            computed=computed,
        )
        # First of all: the terminal may be closed.
        if found.refined is not None:
            write_refined(pattern, found.refined, facts, io.binning)
        write_capture(options.capture, found)
        mark = " (SIMULATED)" if found.simulated else ""
        typer.echo(f"camera registered to {found.camera_residual_px:.2f} px{mark}")
        if found.background_estimated:
            typer.echo("Background estimated (--as-is): the darkest 10 x 10 pixels.", err=True)
        if found.refined is not None:
            first, best = found.refined.psnr_db[0], found.capture.scores.asked_psnr_db
            typer.echo(f"camera in the loop: {first:.2f} dB -> {best:.2f} dB; {written[0]}")
        typer.echo(f"photographed: {score_words(found.capture.scores)}")
        _warn_of_saturation(found.capture.saturated_fraction)
        typer.echo(f"Wrote {options.capture}")
        _end_early(found.refined.ended_by if found.refined is not None else None)


def _capture_spots(
    io: DisplayBench,
    fields: list[Any],
    facts: dict[str, Any],
    pattern: Path,
    options: ShowOptions,
    place: Alignment | None,
) -> None:
    """Photograph spots, say how even they are, write."""
    import numpy as np

    from calibration_routines.display.hologram_photograph import display_of_pattern, refined_path
    from calibration_routines.display.spot_photograph import photograph_spots, write_spots_seen
    from instrument.display.spots import spots_of_facts
    from instrument.files.slm_image import phase_levels, write_slm_image
    from recon.holography import HologramOptions

    assert options.capture is not None
    opened = io.bench
    assert opened.slm is not None
    slm = opened.slm.shape, opened.slm.pixel_pitch_um
    said = facts["options"]
    computed = HologramOptions(
        seed=said["seed"], phase_levels=said["phase_levels"], envelope=said["envelope"]
    )
    written = (refined_path(pattern), options.capture) if options.refine else (options.capture,)
    with saying_what_is_left(*written):
        found = photograph_spots(
            io,
            np.array(fields),
            display_of_pattern(opened.config, slm, facts, place),
            spots_of_facts(pattern, facts),
            options,
            computed,
            progress=lambda n, deviation: typer.echo(f"round {n}: deviation {deviation:.2%}", err=True),
        )
        simulated = bool(opened.simulated_kinds)
        if options.refine:  # first of all: the terminal may be closed
            kept = {name: fact for name, fact in facts.items() if name not in ("format", "levels_per_turn")}
            kept |= {"refined_by_camera": True, "captured_deviations": list(found.deviations)}
            write_slm_image(written[0], phase_levels(np.angle(found.slm[0]), io.binning), kept)
        write_spots_seen(options.capture, found, simulated=simulated)
        mark = " (SIMULATED)" if simulated else ""
        typer.echo(f"camera registered to {found.camera_residual_px:.2f} px{mark}")
        first, best = found.deviations[0], min(found.deviations)
        if options.refine:
            typer.echo(f"camera in the loop: deviation {first:.2%} -> {best:.2%}; {written[0]}")
        least, greatest = found.relative.min(), found.relative.max()
        typer.echo(
            f"photographed: {len(found.relative)} spots, {least:.3f} to {greatest:.3f} of what was asked "
            f"for, deviation {best:.2%}"
        )
        typer.echo(f"Wrote {options.capture}")
        _end_early(found.ended_by)


def _show_run(run: Path, picture: Path | None) -> None:
    """Say how a run ended, what it holds, with which bench and software; draw a sheet of its frames."""
    from instrument.runs.inspection import contact_sheet, verify
    from instrument.runs.run import Run

    found = Run.open(run)
    with one_task("Reading every frame") as advance:
        looked = verify(found, advance)
    for name, value in [*_facts(found), *(("DAMAGED", line) for line in looked.lines())]:
        typer.echo(f"{name + ':':<14}{value}")
    if remedy := looked.remedy():
        typer.echo(f"{'to do:':<14}{remedy}")
    damaged = {frame.index for frame in looked.damaged}
    target = picture or run / "summary.png"
    with one_task("Drawing"):
        drawn = contact_sheet(found, target, leave_out=damaged)
    if drawn:
        typer.echo(f"{'picture:':<14}{target}")


def _facts(run: Run) -> list[tuple[str, str]]:
    from instrument.files.errors import ranges, size

    origin = run.provenance
    facts = [
        ("run", run.path.name + ("  SIMULATED" if run.is_simulated else "")),
        ("became", run.condition + (f": {run.error}" if run.error else "")),
        ("frames", f"{len(run.records)} of {run.n_frames}"),
    ]
    if run.plan is not None:
        facts += [(part.label, f"{len(part)} frames, mean of {part.average}") for part in run.plan.parts]
    else:
        words = f"{sum(gap.count for gap in run.gaps)} in {len(run.gaps)} gaps"
        if run.lost:
            words += f"; {len(run.lost)} after they were stored: {ranges(sorted(run.lost), 8)}"
        facts.append(("lost", words))
        if run.unlisted:
            facts.append(("no metadata", f"{len(run.unlisted)} images: {ranges(sorted(run.unlisted), 8)}"))
        if run.frame_period_s:
            facts.append(("rate", f"{1 / run.frame_period_s:.3f} frames/s"))
    if run.has_frames:
        array = run.array
        facts.append(("image", f"{' x '.join(map(str, array.frame_shape))} {array.dtype}"))
        facts.append(("bytes", size(sum(record.n_bytes for record in run.records.values()))))
    saturated = [i for i, record in run.records.items() if record.metadata.saturated_fraction > 0]
    if saturated:
        facts.append(("saturated", f"{len(saturated)} frames, the first is {saturated[0]}"))
    facts.append(("started", f"{run.state['started_utc']} (UTC)"))
    facts += [(kind, str(device)) for kind, device in origin["devices"].items()]
    facts.append(
        ("software", f"diffuserbench {origin['packages']['diffuserbench']}, Python {origin['python']}")
    )
    if origin["git_commit"]:
        facts.append(("commit", origin["git_commit"]))
    facts.append(("host", origin["host"]))
    return facts
