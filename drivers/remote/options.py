"""What ``bench.toml`` says of a device on another computer, and where the token lies."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import Field

from drivers.device import DriverOptions
from drivers.remote.wire import PORT


class RemoteOptions(DriverOptions):
    """Options of a device that another computer serves."""

    url: str = Field(
        f"http://127.0.0.1:{PORT}",
        pattern=r"^https?://[^/\s]+/?$",
        description="Where diffuserbench serve runs, as it says when it begins.",
    )
    token_file: str | None = Field(
        None,
        min_length=1,
        description="File that holds the server's token; left out: where serve keeps it on this computer.",
    )
    lost_after_s: float = Field(
        5.0, ge=1, description="The connection is lost when the server is silent for this long, seconds."
    )


def token_place() -> Path:
    """Return where a user's token lies unless another file is named."""
    home = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(home).expanduser() / "diffuserbench" / "token"
