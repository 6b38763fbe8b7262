"""Tests that need kernel devices run in the virtual machine of ``run.sh``, and are skipped elsewhere."""

from __future__ import annotations

import pytest

from tests.kernel_vm.machine import in_virtual_machine

# Tests run as root on devices that the kernel makes up: never on somebody's own machine.
REASON = "runs in the virtual machine: tests/kernel_vm/run.sh (see tests/kernel_vm/README.md)"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if not in_virtual_machine():
        for item in items:
            if item.get_closest_marker("kernel_vm"):
                item.add_marker(pytest.mark.skip(reason=REASON))
