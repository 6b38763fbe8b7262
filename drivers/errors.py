"""What can go wrong with a device, in words an operator can act on."""

from __future__ import annotations


class DeviceError(Exception):
    """A device is missing, does not answer, refuses, or was unplugged.

    Parameters
    ----------
    device : str
        The device as the configuration names it, e.g. ``"camera (simulated)"``.
    problem : str
        What was found and what was expected.
    remedy : str, optional
        What the operator can do about it.
    """

    def __init__(self, device: str, problem: str, remedy: str = "") -> None:
        self.device = device
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{device}: {problem}" + (f" {remedy}" if remedy else ""))


class DeviceNotOpenError(DeviceError):
    """A device was used before ``open`` or after ``close``."""

    def __init__(self, device: str) -> None:
        super().__init__(device, "is not open.", "Open it first (Bench does so on entering its context).")


class DeviceLostError(DeviceError):
    """A device that was open is gone: unplugged, switched off, taken by another program."""


class DeviceTimeoutError(DeviceError):
    """A device did not answer or finish in the time it was given."""


class LimitError(DeviceError):
    """A value or a move outside what the device allows. Refused whole: nothing was changed, nothing moved."""


class StoppedError(DeviceError):
    """A blocking call (a move, an exposure) ended early because ``stop`` was called."""
