"""The bench itself: ``new``, ``check``, ``drivers``, ``devices``, and ``gui``, the desktop program."""

from __future__ import annotations

import gc
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from instrument.cli.app import App, BenchOption, examples, load_and_say, signals_wait
from instrument.cli.progress import one_task
from instrument.files.errors import BenchError, FileError

if TYPE_CHECKING:
    from rich.console import Console

    from drivers.device import Device, FoundDevice, Setting
    from drivers.registry.registry import Listing
    from drivers.sequence import SequenceLimits
    from instrument.bench.bench import Bench

new_app, check_app, drivers_app, devices_app, gui_app = App(), App(), App(), App(), App()

LOOKING = "Looking for what is connected"
_OF_THE_WINDOW = ("PySide6", "shiboken6", "pyqtgraph")


@new_app.command(
    epilog=examples(
        "diffuserbench new",
        "diffuserbench new benches/microscope.toml",
        "diffuserbench new --force          overwrite an existing bench.toml",
        "diffuserbench new display.toml --display",
        "diffuserbench new microscope.toml --microscope",
        "diffuserbench new screen.toml --screen",
    )
)
def new(
    out: Annotated[Path, typer.Argument(help="The file to write.", metavar="FILE")] = Path("bench.toml"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
    camera: Annotated[
        bool, typer.Option("--camera", help="A camera behind a diffuser (the default where nobody is asked).")
    ] = False,
    display: Annotated[bool, typer.Option("--display", help="A holographic display instead.")] = False,
    led_microscope: Annotated[
        bool,
        typer.Option(
            "--microscope", "--led-microscope", help="An LED array microscope instead, for calibrate dpc."
        ),
    ] = False,
    screen: Annotated[
        bool, typer.Option("--screen", help="A camera before a monitor instead, for calibrate screen.")
    ] = False,
    look: Annotated[
        bool, typer.Option("--look/--no-look", help="Add what is connected here, as comments to be used.")
    ] = True,
) -> None:
    """Write a commented bench.toml in which every key is explained: the simulated bench to start from.

    In a terminal you are asked which bench it is to be. The lines of real devices that are connected, as
    diffuserbench devices prints them, stand at the file's end, ready to be put in.
    """
    from instrument.bench.config_file import DEFAULT_NAME, TEMPLATES, template
    from instrument.files.atomic import require_new, write_text

    if out.is_dir():
        raise FileError(out, "is a folder.", f"Name a file in it, e.g. {out / DEFAULT_NAME}")
    require_new(out, overwrite=force)
    given = dict(zip(TEMPLATES, (camera, display, led_microscope, screen), strict=True))
    chosen = [name for name, is_set in given.items() if is_set]
    if len(chosen) > 1:
        raise BenchError("Give one of --camera, --display, --microscope and --screen.")
    name = chosen[0] if chosen else _asked_for(TEMPLATES)
    found = ""
    if look:
        with one_task(LOOKING):
            found = _found_lines()
    write_text(out, template(name) + found)
    typer.echo(f"Wrote {out}: a SIMULATED {TEMPLATES[name][0]}.")
    if found:
        typer.echo(
            "What is connected here stands at its end: put those lines in the place of simulated ones."
        )
    typer.echo(f"Next: diffuserbench check{'' if out == Path(DEFAULT_NAME) else f' --bench {out}'}")


def _asked_for(templates: Mapping[str, tuple[str, str]]) -> str:
    """Ask which bench it is to be; the first where nobody can answer."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return next(iter(templates))
    names = list(templates)
    for number, (what, _) in enumerate(templates.values(), 1):
        typer.echo(f"  {number}  {what}", err=True)
    answer = str(typer.prompt("Which bench", default="1", err=True)).strip()
    if not answer.isdecimal() or not 1 <= int(answer) <= len(names):
        raise BenchError(f"There is no bench {answer!r}: a number from 1 to {len(names)} is expected.")
    return names[int(answer) - 1]


def _found_lines() -> str:
    """Return the lines of bench.toml for what is connected, as comments; empty where nothing is."""
    from drivers.registry.registry import list_devices

    rows: list[str] = []
    for device in list_devices(probe=False, say=lambda _: None).found:
        if lines := device.bench_lines():
            rows += ["#", f"# {_device_line(device)}", *(f"# {line}" for line in lines.splitlines())]
    return "\n".join(["", "# Connected here (diffuserbench devices):", *rows, ""]) if rows else ""


@check_app.command(
    epilog=examples(
        "diffuserbench check",
        "diffuserbench check --bench benches/microscope.toml",
        "diffuserbench check --thorough          and write a report to send",
    )
)
def check(
    bench: BenchOption = None,
    thorough: Annotated[
        bool,
        typer.Option(
            "--thorough",
            help="Use the devices too (light, pictures, photographs), and write a report of it.",
        ),
    ] = False,
    move: Annotated[
        bool,
        typer.Option("--move", help="With --thorough: move axes of a homed stage by little, and back."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="The report, by default bench-report-DATE.txt."),
    ] = None,
) -> None:
    """Open every device that the bench configuration names, report identity, settings and limits of each.

    Ends with the light off. Nothing moves without --move. Exit status 1 when a device fails; all failures
    are reported. The report has the configuration, what every device says of itself, and the measurements.
    """
    from rich.console import Console

    from drivers.errors import DeviceError
    from instrument.bench.bench import Bench
    from instrument.bench.safety import StepsFailedError
    from instrument.files.atomic import require_new

    if (move or out is not None) and not thorough:
        raise BenchError("--move and --out belong to --thorough.")
    if out is not None:
        require_new(out)
    console = Console(record=thorough)
    config = load_and_say(bench)
    opened = Bench(config)
    failures: list[str] = []
    measured: list[str] = []
    try:
        for kind in opened.devices:
            try:
                with one_task(f"Opening: {kind}"):
                    device = opened.open_device(kind)
                _print_device(console, kind, device)
            except DeviceError as error:
                failures.append(str(error))
        label = opened.label
        if thorough and not failures:
            measured = _measured(opened, failures, moves=move)
    finally:
        try:
            opened.close()
        except StepsFailedError as error:
            failures.append(str(error))
    if thorough:
        file = _write_report(out, config.text, console.export_text(), measured, failures)
        typer.echo(f"Report: {file}")
    if failures:
        for failure in failures:
            typer.echo(f"FAILED  {failure}", err=True)
        typer.echo(f"{len(failures)} failure{'s' if len(failures) > 1 else ''}: {config.label}", err=True)
        raise typer.Exit(1)
    console.print(f"All {len(opened.devices)} devices answer: {label}", markup=False, soft_wrap=True)
    console.print("Light off, nothing moving, devices closed.")


def _measured(bench: Bench, failures: list[str], *, moves: bool) -> list[str]:
    """Measure what only hardware can tell, saying each finding; failures are added to those there are."""
    from instrument.bench.thorough import thorough

    lines = []
    for finding in thorough(bench, moves=moves):
        lines.append(str(finding))
        typer.echo(lines[-1])
        if finding.failed:
            failures.append(f"{finding.device}: {finding.test}: {finding.words}")
    return lines


def _write_report(
    out: Path | None, configuration: str, said: str, measured: list[str], failures: list[str]
) -> Path:
    """Write what a lab sends to whoever is to help: versions, configuration, devices, measurements."""
    import platform
    from importlib.metadata import version

    from instrument.files.atomic import write_text
    from instrument.runs.writer import dated_name, free_name

    file = out or free_name(Path(), f"bench-report-{dated_name('check')}", ".txt")
    head = (
        f"diffuserbench {version('diffuserbench')}, Python {platform.python_version()}, {platform.platform()}"
    )
    parts = {
        "Measured": "\n".join(measured) or "nothing: a device failed before",
        "Failures": "\n".join(failures) or "none",
        "Devices": said.rstrip(),
        "bench.toml": configuration.rstrip(),
    }
    sections = "".join(f"\n{name}\n{'-' * len(name)}\n{text}\n" for name, text in parts.items())
    write_text(file, f"{head}\n{sections}")
    return file


def _print_device(console: Console, kind: str, device: Device) -> None:
    from rich import box
    from rich.table import Table

    identity = device.identity
    mark = "  SIMULATED" if identity.simulated else ""
    console.print(f"{kind}: {identity.vendor} {identity.model}{mark}", markup=False, style="bold")
    table = Table(show_header=False, box=box.ROUNDED)
    table.add_column("what", no_wrap=True)
    table.add_column("value", overflow="fold")
    table.add_row("driver", identity.driver)
    table.add_row("serial number", identity.serial_number)
    table.add_row("firmware", identity.firmware, end_section=True)
    for name, value in _settings(device.settings()):
        table.add_row(name, value)
    table.add_section()
    for name, value in _limits(device):
        table.add_row(name, value)
    console.print(table)


def _settings(settings: Mapping[str, Setting]) -> Iterator[tuple[str, str]]:
    for name, value in settings.items():
        yield name, _text(value)


def _limits(device: Device) -> Iterator[tuple[str, str]]:
    from drivers.camera import Camera
    from drivers.led_array import LedArray
    from drivers.slm import Slm
    from drivers.stage import Stage

    if isinstance(device, Camera):
        yield "sensor, pixels", "{} x {}".format(*device.sensor_shape)
        yield "pixel pitch", f"{device.pixel_pitch_um:g} um"
        yield "exposure limits", "{:g} to {:g} ms".format(*device.exposure_limits_ms)
        yield "gain limits", "{:g} to {:g}".format(*device.gain_limits)
        yield "binnings", _text(device.binnings)
        yield "pixel formats", _text(device.pixel_formats)
        yield "trigger modes", _text(device.trigger_modes)
        if device.trigger_lines:
            yield "trigger lines", _text(device.trigger_lines)
    elif isinstance(device, Stage):
        for axis in device.axes:
            yield (
                f"axis {axis.name}",
                f"{axis.lower_limit:g} to {axis.upper_limit:g} {axis.unit}, "
                f"{axis.speed_per_s:g} {axis.unit}/s, smallest step {axis.resolution:g} {axis.unit}",
            )
    elif isinstance(device, LedArray):
        yield "LEDs", str(len(device.led_positions_mm))
        yield "wavelengths", f"{_text(device.wavelengths_nm)} nm"
        yield "largest NA", f"{float(cast(float, abs(device.led_na).max())):.3g}"
        yield "sequences", _sequences(device.sequence_limits)
    elif isinstance(device, Slm):
        yield "pixels", "{} x {}".format(*device.shape)
        yield "pixel pitch", f"{device.pixel_pitch_um:g} um"
        yield "settle time", f"{device.settle_ms:g} ms"
        yield "sequences", _sequences(device.sequence_limits)


def _sequences(limits: SequenceLimits | None) -> str:
    if limits is None:
        return "none with pulses"
    return (
        f"up to {limits.most} patterns, {limits.shortest_ms:g} ms or more apart, "
        f"{limits.outputs} trigger output{'' if limits.outputs == 1 else 's'}"
    )


def _text(value: Setting) -> str:
    if isinstance(value, tuple):
        return ", ".join(_text(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


@drivers_app.command(epilog=examples("diffuserbench drivers"))
def drivers() -> None:
    """List the installed drivers for each kind of device: the names to put behind driver = in bench.toml.

    No device is touched. Their keys are in docs/reference/bench-toml.md, or in the documentation of the
    package that brings them.
    """
    from drivers.registry.registry import KINDS, driver_names, registration_mistakes

    width = max(map(len, KINDS)) + 2
    for kind in KINDS:
        typer.echo(f"{kind:<{width}}{', '.join(driver_names(kind)) or 'none'}")
    for sentence in registration_mistakes():
        typer.echo(sentence, err=True)


@devices_app.command(
    epilog=examples(
        "diffuserbench devices", "diffuserbench devices --probe", "diffuserbench devices --json > found.json"
    )
)
def devices(
    probe: Annotated[
        bool,
        typer.Option(
            "--probe",
            help="Ask at serial ports too, by writing to them: not where a stray command can do harm.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """List what is connected: USB, HID, serial ports, video devices, GenICam cameras, displays.

    Devices that a driver is sure of come with the lines to put into bench.toml. Without --probe nothing is
    written to any serial port, so a stage behind a common USB adapter is only listed as a port.
    """
    from drivers.registry.registry import list_devices

    with one_task(LOOKING):
        listing = list_devices(probe=probe, say=lambda sentence: typer.echo(sentence, err=True))
    typer.echo(_listing_json(listing) if as_json else _listing_words(listing))


def _listing_json(listing: Listing) -> str:
    found = [{**asdict(device), "bench_toml": device.bench_lines()} for device in listing.found]
    return json.dumps({"found": found, "unavailable": listing.unavailable}, indent=2, default=str)


def _listing_words(listing: Listing) -> str:
    from drivers.device import BUSES

    lines: list[str] = []
    others = sorted({device.bus for device in listing.found} - set(BUSES))
    for bus in (*BUSES, *others):
        found = [device for device in listing.found if device.bus == bus]
        unseen = any(sentence.startswith(f"{bus}:") for sentence in listing.unavailable)
        nothing = "could not be looked at, see below" if unseen else "none found"
        lines.append(f"{bus}:" if found else f"{bus}: {nothing}")
        for device in found:
            lines.append(f"  {_device_line(device)}")
            lines += [f"      {row}" for row in device.bench_lines().splitlines()]
    if listing.unavailable:
        lines += ["", "Could not be looked at:", *(f"  {sentence}" for sentence in listing.unavailable)]
    return "\n".join(lines)


def _device_line(device: FoundDevice) -> str:
    parts = [f"{device.address}  {device.description}"]
    if device.usb_id:
        parts.append(device.usb_id)
    if device.serial_number:
        parts.append(f"serial {device.serial_number}")
    return ", ".join(parts)


@gui_app.command(
    epilog=examples("diffuserbench gui", "diffuserbench gui bench.toml"),
)
def gui(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[BENCH.TOML]",
            help="Bench configuration. Default: bench.toml here, else a page to start from.",
            show_default=False,
        ),
    ] = None,
    bench: Annotated[
        Path | None,
        typer.Option(
            "--bench", "-b", metavar="FILE", help="The same, as all commands take it.", show_default=False
        ),
    ] = None,
) -> None:
    """Open the desktop program: live view, stage, light, sweeps, reconstructions, holograms.

    Closing the window, Ctrl-C and SIGTERM end it safely: light off, motion stopped, runs closed.
    """
    if file is not None and bench is not None:
        raise BenchError(f"Two benches are named, {file} and {bench}: give one.")
    bench = file if bench is None else bench
    from instrument.bench.config_file import DEFAULT_NAME

    try:
        config = load_and_say(bench) if bench is not None or Path(DEFAULT_NAME).exists() else None
    except BenchError as error:
        _show_too(error)
        raise
    gc.disable()  # a tenth of the start goes into looking at what is imported; the window turns it on again
    try:
        with signals_wait():
            from gui.app import run
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in _OF_THE_WINDOW:
            raise
        raise BenchError(
            f'The desktop program needs {error.name}. Install it: pip install "diffuserbench[gui]"'
        ) from None
    except ImportError as error:  # a library of the system that Qt needs, e.g. libEGL.so.1
        raise BenchError(
            f"The desktop program cannot start: {error}. On Debian: sudo apt install libegl1 libgl1 "
            "libxkbcommon0 libfontconfig1 libdbus-1-3 libxcb-cursor0 libxcb-icccm4 libxcb-keysyms1"
        ) from None
    raise typer.Exit(run(config))


def _show_too(error: BenchError) -> None:
    """Show a mistake in a window: started from a menu, there is no terminal where it would be read."""
    try:
        from gui.app import show_mistake
    except ImportError:  # the terminal tells it
        return
    show_mistake(error)
