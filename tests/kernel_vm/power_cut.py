"""A power cut at every moment of a run, from a log of the disk's own writes.

    KERNEL_VM_SECONDS=900 tests/kernel_vm/run.sh .venv/bin/python -m tests.kernel_vm.power_cut

The kernel's dm-log-writes lies below an ext4 file system and records each write and each flush of the disk's
cache while a run is stored. For each flush the disk is made again as it was then, mounted (its journal is
replayed), and the run opened: every frame whose ``write`` had returned must be there, whole and itself. Exit
status 1 when one is not.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from instrument.plan import Part, Plan
from instrument.runs.run import FinishReason, Run
from instrument.runs.writer import FrameToStore, RunWriter
from tests.instrument.runs.test_store_order import BENCH, METADATA
from tests.kernel_vm.machine import load_module

_HERE = Path("/run/power-cut")
_DISK_BYTES, _SECTOR = 8 << 20, 512
_HEADER, _ENTRY = struct.Struct("<QQQI"), struct.Struct("<QQQQ")
_FLUSH, _FUA, _DISCARD, _MARK = 1, 2, 4, 8
FRAMES = 12


def _do(*command: object) -> str:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{command}: {done.stderr}")
    return done.stdout.strip()


def _logged(mount: Path) -> None:
    """Store a run on a disk whose writes are logged; each frame that is promised is marked in the log."""
    (_HERE / "disk").write_bytes(bytes(_DISK_BYTES))
    (_HERE / "log").write_bytes(bytes(16 * _DISK_BYTES))
    _do("mkfs.ext4", "-q", "-F", _HERE / "disk")
    shutil.copyfile(_HERE / "disk", _HERE / "before")
    disk, log = (_do("losetup", "--find", "--show", _HERE / name) for name in ("disk", "log"))
    table = f"0 {_DISK_BYTES // _SECTOR} log-writes {disk} {log}"
    _do("dmsetup", "create", "--noudevsync", "logged", "--table", table)
    _do("dmsetup", "mknodes", "logged")
    _do("mount", "/dev/mapper/logged", mount)
    plan = Plan(label="cut", parts=(Part(label="a", repeats=FRAMES),))
    with RunWriter.create(mount, label="cut", bench=BENCH, plan=plan) as writer:
        writer.start(steps=FRAMES)
        for index in range(FRAMES):
            writer.write([FrameToStore(index, np.full((4, 5), index, np.uint8), METADATA)])
            _do("dmsetup", "message", "logged", 0, "mark", f"frame-{index}")
        writer.finish(FinishReason.COMPLETED)
    _do("dmsetup", "message", "logged", 0, "mark", "completed")
    _do("umount", mount)
    _do("dmsetup", "remove", "--noudevsync", "logged")
    for device in (disk, log):
        _do("losetup", "--detach", device)


def _entries() -> Iterator[tuple[int, int, bytes]]:
    """Yield sector, flags and data of each entry of the log; a mark's data are its words."""
    with (_HERE / "log").open("rb") as file:
        _, _, count, block = _HEADER.unpack(file.read(_HEADER.size))
        file.seek(block)
        for _ in range(count):
            head = file.read(block)
            sector, sectors, flags, n_bytes = _ENTRY.unpack_from(head)
            if flags & _MARK:
                yield 0, flags, head[_ENTRY.size :][:n_bytes]
            else:
                yield sector, flags, b"" if flags & _DISCARD else file.read(sectors * _SECTOR)


def _problems(mount: Path, promised: Sequence[str]) -> list[str]:
    """Return what is wrong with the disk as it was after a power cut."""
    _do("mount", "-o", "loop", _HERE / "cut", mount)
    try:
        runs = [path for path in mount.iterdir() if path.name[0] != "." and path.name != "lost+found"]
        frames = {int(words.removeprefix("frame-")) for words in promised if words.startswith("frame")}
        if not runs:
            return [f"no run, and {len(frames)} frames promised"] * bool(frames)
        run = Run.open(runs[0])
        found = [f"frame {index} lost" for index in sorted(frames - set(run.records))]
        for index in run.records:
            if run.verify(index) is not None or not np.all(run.frame(index) == index):
                found.append(f"frame {index} is damaged or another")
        if "completed" in promised and run.reason is not FinishReason.COMPLETED:
            found.append("not completed")
        return found
    finally:
        _do("umount", mount)


def main() -> int:
    """Store a run, cut the power at each flush, and say what was lost."""
    for module in ("loop", "dm-log-writes", "ext4"):
        load_module(module)
    mount = _HERE / "mount"
    mount.mkdir(parents=True)
    _logged(mount)
    disk = bytearray((_HERE / "before").read_bytes())
    promised: list[str] = []
    cuts = writes = wrong = 0
    for sector, flags, data in _entries():  # each after those that the disk had to have before it
        if flags & _MARK:
            promised.append(data.rstrip(b"\0").decode())
        elif data:
            disk[sector * _SECTOR : sector * _SECTOR + len(data)] = data
            writes += 1
        if flags & (_FLUSH | _FUA | _MARK):
            (_HERE / "cut").write_bytes(disk)
            cuts += 1
            for problem in _problems(mount, promised):
                wrong += 1
                print(f"write {writes}, {len(promised)} promised: {problem}", flush=True)
    print(f"{cuts} power cuts among {writes} writes, {len(promised)} promises: {wrong} wrong")
    return int(wrong > 0 or "completed" not in promised)


if __name__ == "__main__":
    sys.exit(main())
