"""``diffuserbench devices``: what is connected to this computer."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

from drivers.registry.discovery import BUSES, FoundDevice
from drivers.registry.listing import Listing, list_devices
from instrument.cli.app import App, examples

app = App()


@app.command(
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
    listing = list_devices(probe=probe, say=lambda sentence: typer.echo(sentence, err=True))
    typer.echo(_json(listing) if as_json else _words(listing))


def _json(listing: Listing) -> str:
    found = [{**asdict(device), "bench_toml": device.bench_lines()} for device in listing.found]
    return json.dumps({"found": found, "unavailable": listing.unavailable}, indent=2, default=str)


def _words(listing: Listing) -> str:
    lines: list[str] = []
    others = sorted({device.bus for device in listing.found} - set(BUSES))
    for bus in (*BUSES, *others):
        found = [device for device in listing.found if device.bus == bus]
        unseen = any(sentence.startswith(f"{bus}:") for sentence in listing.unavailable)
        nothing = "could not be looked at, see below" if unseen else "none found"
        lines.append(f"{bus}:" if found else f"{bus}: {nothing}")
        for device in found:
            lines.append(f"  {_line(device)}")
            lines += [f"      {row}" for row in device.bench_lines().splitlines()]
    if listing.unavailable:
        lines += ["", "Could not be looked at:", *(f"  {sentence}" for sentence in listing.unavailable)]
    return "\n".join(lines)


def _line(device: FoundDevice) -> str:
    parts = [f"{device.address}  {device.description}"]
    if device.usb_id:
        parts.append(device.usb_id)
    if device.serial_number:
        parts.append(f"serial {device.serial_number}")
    return ", ".join(parts)
