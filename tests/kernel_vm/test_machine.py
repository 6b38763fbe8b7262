"""What every other test here relies on: the kernel's virtual devices exist."""

from __future__ import annotations

from pathlib import Path

import pytest

pytestmark = pytest.mark.kernel_vm


@pytest.mark.parametrize(
    "node", ["/dev/video0", "/dev/uhid", "/sys/class/udc/dummy_udc.0", "/sys/kernel/config/usb_gadget"]
)
def test_the_virtual_device_is_there(node: str) -> None:
    assert Path(node).exists()
