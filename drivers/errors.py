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
        super().__init__(_sentence(device, problem, remedy))

    def name_part(self, part: str) -> None:
        """Say that the device is a part of another, in the message too; saying it twice does nothing."""
        addition = f", part {part}"
        if not self.device.endswith(addition):
            self.device += addition
            self.args = (_sentence(self.device, self.problem, self.remedy),)


class DeviceNotOpenError(DeviceError):
    """A device was used before ``open`` or after ``close``."""

    def __init__(self, device: str) -> None:
        super().__init__(device, "is not open.", "Open it first; where it was lost, reconnect it.")


class DeviceLostError(DeviceError):
    """A device that was open is gone: unplugged, switched off, taken by another program."""


class DeviceTimeoutError(DeviceError):
    """A device did not answer or finish in the time it was given."""


class LimitError(DeviceError):
    """A value or a move outside what the device allows. Refused whole: nothing was changed, nothing moved."""


class StoppedError(DeviceError):
    """A blocking call (a move, an exposure) ended early because ``stop`` was called."""


def _sentence(device: str, problem: str, remedy: str) -> str:
    return f"{device}: {problem}" + (f" {remedy}" if remedy else "")
