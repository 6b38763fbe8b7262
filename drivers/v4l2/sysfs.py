"""What the kernel's file system says of a video device that is on USB."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path("/sys/class/video4linux")


def usb_strings(node: str) -> dict[str, str]:
    """Return ``manufacturer``, ``product`` and ``serial`` of a node, where it is on USB and has them."""
    interface = (_FOLDER / Path(node).resolve().name / "device").resolve()
    found = {}
    for name in ("manufacturer", "product", "serial"):
        try:
            text = (interface.parent / name).read_text("utf-8", errors="replace").strip()
        except OSError:
            continue
        if text:
            found[name] = text
    return found


def lasting_path(node: str) -> str:
    """Return the link in ``/dev/v4l/by-id`` to a node, which stays the same when cameras are plugged anew."""
    for link in sorted(Path("/dev/v4l/by-id").glob("*")):
        if link.resolve() == Path(node).resolve():
            return str(link)
    return node
