"""Making, naming and locking a run folder."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
from datetime import datetime
from pathlib import Path

from instrument.files.atomic import write_bytes
from instrument.plan import Plan
from instrument.runs.durable import make_folder
from instrument.runs.run import LOCK, SLM_IMAGES, RunError


def plan_with_copies(plan: Plan, folder: Path) -> Plan:
    """Copy a plan's SLM images into a folder, so that the run can be continued and understood later."""
    if plan.slm_images:
        make_folder(folder / SLM_IMAGES)
    copies: dict[Path, Path] = {}
    for path in plan.slm_images:
        data = path.read_bytes()
        copies[path] = Path(SLM_IMAGES) / f"{hashlib.sha256(data).hexdigest()[:16]}{path.suffix}"
        write_bytes(folder / copies[path], data)
    return plan.with_slm_images(copies.__getitem__)


def lock_run(path: Path) -> int:
    """Return a handle that holds the run's lock until it is closed or the process ends, however it ends."""
    handle = os.open(path / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise RunError(path, "another program is writing to this run.", "Wait until it ends.") from None
    return handle


def dated_name(label: str) -> str:
    """Return a name for something made now: local date, time and what it is."""
    return f"{datetime.now().astimezone():%Y-%m-%d_%H-%M-%S}_{slug(label)}"


def free_name(parent: Path, name: str, suffix: str = "") -> Path:
    """Return a path for a new run or file, with a number before the suffix when its name is taken."""
    path, number = parent / f"{name}{suffix}", 1
    while path.exists() or (parent / f".{path.name}.draft").exists():
        number += 1
        path = parent / f"{name}-{number}{suffix}"
    return path


def slug(label: str) -> str:
    """Return a label as part of a folder's name."""
    return re.sub(r"[^\w.+-]+", "-", label).strip("-.") or "run"


def disk_remedy(error: OSError) -> str:
    """Return what to do about a disk that refuses, empty where nothing is known."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "Free some disk space; diffuserbench resume continues the run."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "Choose a folder that you may write to."
    return ""
