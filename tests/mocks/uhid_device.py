"""A HID device made up by the kernel (``uhid``), answered by a function."""

from __future__ import annotations

import os
import select
import struct
import threading
from collections.abc import Callable

DESTROY, OUTPUT, CREATE2, INPUT2 = 1, 6, 11, 12
BUS_USB = 3
EVENT_BYTES = 4380
DATA_BYTES = 4096
# One vendor-defined collection with 64-byte input and output reports without numbers.
DESCRIPTOR = bytes.fromhex("0600ff0901a101150026ff007508954009018102954009019102c0")


class UhidDevice:
    """A device with 64-byte reports; ``answer`` takes each report and returns those to send back."""

    def __init__(
        self, vendor: int, product: int, name: str, serial: str, answer: Callable[[bytes], list[bytes]]
    ) -> None:
        self._answer = answer
        self._file = os.open("/dev/uhid", os.O_RDWR | os.O_CLOEXEC)
        head = struct.pack("<I128s64s64s", CREATE2, name.encode(), b"", serial.encode())
        numbers = struct.pack("<HHIIII", len(DESCRIPTOR), BUS_USB, vendor, product, 0, 0)
        os.write(self._file, head + numbers + DESCRIPTOR)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Remove the device; once only."""
        self._stopping.set()
        self._thread.join()
        os.write(self._file, struct.pack("<I", DESTROY))
        os.close(self._file)

    def _run(self) -> None:
        while not self._stopping.is_set():
            if not select.select([self._file], [], [], 0.05)[0]:
                continue
            event = os.read(self._file, EVENT_BYTES)
            if struct.unpack_from("<I", event)[0] != OUTPUT:
                continue
            (size,) = struct.unpack_from("<H", event, 4 + DATA_BYTES)
            # hidraw keeps the report number, 0, before the report.
            for reply in self._answer(event[4 : 4 + size][-64:].ljust(64, b"\0")):
                os.write(self._file, struct.pack("<IH", INPUT2, len(reply)) + reply)
