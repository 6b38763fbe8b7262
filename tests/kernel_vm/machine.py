"""The virtual machine as its tests see it."""

from __future__ import annotations

import os
import subprocess


def in_virtual_machine() -> bool:
    """Whether this runs in the virtual machine of ``run.sh``."""
    return os.environ.get("DIFFUSERBENCH_KERNEL_VM") == "1"


def load_module(*arguments: str) -> None:
    """Load a kernel module with its parameters: ``load_module("vivid", "n_devs=1")``."""
    _modprobe(*arguments)


def remove_module(name: str) -> None:
    """Remove a kernel module; its devices vanish as if unplugged."""
    _modprobe("-r", name)


def _modprobe(*arguments: str) -> None:
    done = subprocess.run(
        [*os.environ["MODPROBE"].split(), *arguments], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode == 0, f"modprobe {' '.join(arguments)}: {done.stderr}"
