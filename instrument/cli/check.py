"""``diffuserbench check``: open every device that bench.toml names and report on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import cast

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from drivers.camera import Camera
from drivers.device import Device, Setting
from drivers.errors import DeviceError
from drivers.led_array import LedArray
from drivers.slm import Slm
from drivers.stage import Stage
from instrument.bench.bench import Bench
from instrument.bench.safety import StepsFailedError
from instrument.cli.app import App, BenchOption, examples, load_and_say

app = App()


@app.command(epilog=examples("diffuserbench check", "diffuserbench check --bench benches/microscope.toml"))
def check(bench: BenchOption = None) -> None:
    """Open every device that the bench configuration names, report identity, settings and limits of each.

    Ends with the light off. Nothing moves. Exit status 1 when a device fails; all failures are reported.
    """
    console = Console()
    config = load_and_say(bench)
    opened = Bench(config)
    failures: list[str] = []
    try:
        for kind in opened.devices:
            try:
                device = opened.open_device(kind)
                _print(console, kind, device)
            except DeviceError as error:
                failures.append(str(error))
        label = opened.label
    finally:
        try:
            opened.close()
        except StepsFailedError as error:
            failures.append(str(error))
    if failures:
        for failure in failures:
            typer.echo(f"FAILED  {failure}", err=True)
        typer.echo(f"{len(failures)} failure{'s' if len(failures) > 1 else ''}: {config.label}", err=True)
        raise typer.Exit(1)
    console.print(f"All {len(opened.devices)} devices answer: {label}", markup=False, soft_wrap=True)
    console.print("Light off, nothing moving, devices closed.")


def _print(console: Console, kind: str, device: Device) -> None:
    identity = device.identity
    mark = "  SIMULATED" if identity.simulated else ""
    console.print(f"{kind}: {identity.vendor} {identity.model}{mark}", markup=False, style="bold")
    table = Table(show_header=False, box=box.ROUNDED)
    table.add_column("what", no_wrap=True)
    table.add_column("value", overflow="fold")
    table.add_row("driver", identity.driver)
    table.add_row("serial number", identity.serial_number)
    table.add_row("firmware", identity.firmware, end_section=True)
    for name, value in _flat(device.settings()):
        table.add_row(name, value)
    table.add_section()
    for name, value in _limits(device):
        table.add_row(name, value)
    console.print(table)


def _flat(settings: Mapping[str, Setting]) -> Iterator[tuple[str, str]]:
    for name, value in settings.items():
        yield name, _text(value)


def _limits(device: Device) -> Iterator[tuple[str, str]]:
    if isinstance(device, Camera):
        yield "sensor, pixels", "{} x {}".format(*device.sensor_shape)
        yield "pixel pitch", f"{device.pixel_pitch_um:g} um"
        yield "exposure limits", "{:g} to {:g} ms".format(*device.exposure_limits_ms)
        yield "gain limits", "{:g} to {:g}".format(*device.gain_limits)
        yield "binnings", _text(device.binnings)
        yield "pixel formats", _text(device.pixel_formats)
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
    elif isinstance(device, Slm):
        yield "pixels", "{} x {}".format(*device.shape)
        yield "pixel pitch", f"{device.pixel_pitch_um:g} um"
        yield "settle time", f"{device.settle_ms:g} ms"


def _text(value: Setting) -> str:
    if isinstance(value, tuple):
        return ", ".join(_text(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
