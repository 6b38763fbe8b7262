"""``diffuserbench serve``: the bench's devices for another computer, and a page in the browser."""

from __future__ import annotations

import os
import secrets
import socket
import threading
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from instrument.cli.app import App, BenchOption, examples, load_and_say
from instrument.files.errors import BenchError, FileError
from recon.base.declare import option

if TYPE_CHECKING:
    from instrument.bench.config import BenchConfig

app = App()

_THIS_COMPUTER = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True, kw_only=True)
class ServeOptions:
    """Where a bench is served, and who may use it."""

    host: str = option(
        "127.0.0.1",
        help="Address to listen at: by default for this computer only; 0.0.0.0 for its network.",
        metavar="ADDRESS",
    )
    port: int = option(8470, help="Port to listen at; 0 takes one that is free.", least=0, most=65535)
    token_file: Path | None = option(
        None,
        help="File with the token that programs must send; made where there is none.",
        default_words="diffuserbench/token in ~/.config",
        metavar="FILE",
    )
    lost_after_s: float = option(
        5.0,
        help="An operator whose connection is silent for this long is lost: light off, motion stopped.",
        unit="s",
        least=1.0,
        flags=("--lost-after",),
    )


@app.command(
    epilog=examples(
        "diffuserbench serve                              to programs of this computer",
        "diffuserbench serve --bench pi.toml --host 0.0.0.0     to its network",
    )
)
def serve(options: ServeOptions, bench: BenchOption = None) -> None:
    """Offer the bench's devices to another computer, where the driver is called remote, and to a browser.

    One operator at a time. When his connection is lost, or somebody presses STOP on the page, the light is
    put off and motion stopped. While nobody operates the page shows the camera, and nothing else is open.
    """
    config = load_and_say(bench)
    try:
        from instrument.serve.server import BenchServer, Serving
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "aiohttp":
            raise
        raise BenchError('Serving needs aiohttp. Install it: pip install "diffuserbench[remote]"') from None
    file, token = _token(options.token_file)
    _try_devices(config)
    serving = Serving(token=token, host=options.host, port=options.port, lost_after_s=options.lost_after_s)
    with BenchServer(config, serving, _say) as server:
        _introduce(config, server.url, file, token, options.host)
        threading.Event().wait()


def _say(sentence: str) -> None:
    typer.echo(f"{datetime.now():%H:%M:%S}  {sentence}")


def _introduce(config: BenchConfig, url: str, file: Path, token: str, host: str) -> None:
    url = url.replace("0.0.0.0", socket.gethostname())
    typer.echo(f"Serving {config.label} at {url}")
    typer.echo(f"Token: {file}")
    typer.echo(f"Page:  {url}/#{token}")
    typer.echo("In bench.toml of the computer that operates:")
    for kind in config.devices:
        typer.echo(f'  [{kind}]\n  driver = "remote"\n  url = "{url}"')
        if host not in _THIS_COMPUTER:
            typer.echo(f'  token_file = "token"      # a copy of {file}')
    if host not in _THIS_COMPUTER:
        port = url.rpartition(":")[2]
        typer.echo(
            "What goes over the network is not encrypted, the token neither: only in a network that you "
            f"trust. Otherwise serve without --host, and there: ssh -N -L {port}:127.0.0.1:{port} "
            f"{socket.gethostname()}",
            err=True,
        )
    typer.echo("Ctrl-C ends it: light off, motion stopped.")


def _try_devices(config: BenchConfig) -> None:
    """Open and close each device once, so that what is missing is known at once."""
    from drivers.errors import DeviceError
    from instrument.bench.bench import Bench
    from instrument.bench.safety import StepsFailedError

    bench = Bench(config)
    failed = 0
    try:
        for kind in bench.devices:
            try:
                typer.echo(f"{kind}: {bench.open_device(kind).identity}")
            except DeviceError as error:
                failed += 1
                typer.echo(f"FAILED  {error}", err=True)
    finally:
        try:
            bench.close()
        except StepsFailedError as error:
            typer.echo(str(error), err=True)
    if failed == len(bench.devices):
        raise BenchError(f"None of the devices of {config.label} answers: there is nothing to serve.")
    if failed:
        typer.echo("What failed is tried anew when it is opened from afar.", err=True)


def _token(named: Path | None) -> tuple[Path, str]:
    """Return the file that holds the token, and the token; made, for its user's eyes alone, when missing."""
    from drivers.remote.options import token_place

    file = (named or token_place()).expanduser()
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except FileExistsError:
            token = file.read_text("utf-8").strip()
        else:
            token = secrets.token_urlsafe(24)
            with os.fdopen(handle, "w") as out:
                out.write(f"{token}\n")
        others_may_read = file.stat().st_mode & 0o077
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(file, f"cannot hold the token: {error}.", "Name another by --token-file.") from None
    if len(token) < 16 or any(sign.isspace() for sign in token):
        raise FileError(
            file, "holds no token: one word of 16 signs or more is expected.", "Delete it: a new one is made."
        )
    if others_may_read:
        typer.echo(f"Other users of this computer can read {file}: chmod 600 {file}", err=True)
    return file, token
