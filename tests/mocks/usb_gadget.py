"""A USB serial adapter that the kernel makes up (configfs, dummy_hcd): what its other end sends is ours."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Callable
from pathlib import Path

from tests.mocks.pty_device import Answer, PtyDevice

GADGETS = Path("/sys/kernel/config/usb_gadget")
CONTROLLER = "dummy_udc.0"


class UsbSerialGadget(PtyDevice):
    """Like its base, behind a USB serial port with a vendor, product and serial number of one's choice."""

    def __init__(
        self,
        usb_id: tuple[int, int],
        names: tuple[str, str, str],
        answer: Callable[[bytes], list[Answer]],
        split: Callable[[bytes], tuple[list[bytes], bytes]],
    ) -> None:
        self._gadget = GADGETS / "serial"
        self._describe(usb_id, names)
        super().__init__(Path("/dev"), answer, split)

    def _describe(self, usb_id: tuple[int, int], names: tuple[str, str, str]) -> None:
        texts = self._gadget / "strings" / "0x409"
        function = self._gadget / "functions" / "acm.0"
        configuration = self._gadget / "configs" / "c.1"
        for folder in (texts, function, configuration):
            folder.mkdir(parents=True, exist_ok=True)
        for key, value in zip(("idVendor", "idProduct"), usb_id, strict=True):
            (self._gadget / key).write_text(f"0x{value:04x}")
        for key, text in zip(("manufacturer", "product", "serialnumber"), names, strict=True):
            (texts / key).write_text(text)
        link = configuration / "acm.0"
        if not link.is_symlink():
            link.symlink_to(function)
        self._number = int((function / "port_num").read_text())

    def plug_in(self) -> None:
        (self._gadget / "UDC").write_text(CONTROLLER)
        self._master = os.open(f"/dev/ttyGS{self._number}", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._master)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._master, self._stopping), daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        (self._gadget / "UDC").write_text("\n")
        self._stopping.set()
        self._thread.join()
        os.close(self._master)
