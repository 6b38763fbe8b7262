"""After a power cut at any moment, every line of the log that is on the disk has its frame on the disk.

Files and folders count as on the disk only as they were when last synced; a rename or a new file counts from
the sync of its folder. Writes that were not synced may or may not survive; the harshest case, that none does,
is rebuilt here after every sync and opened as a run.
"""

from __future__ import annotations

import os
import shutil
import threading
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from drivers.frame import FrameMetadata
from instrument.plan import Part, Plan
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_files import RunError
from instrument.runs.writer import BenchRecord, FrameToStore, RunWriter

BENCH = BenchRecord({}, "", {}, True, 6.5, {"exposure_ms": 1.0, "gain": 1.0}, {})
METADATA = FrameMetadata(
    0, None, 0, datetime(2026, 1, 1, tzinfo=UTC), 1.0, 1.0, "Mono8", 8, 0.0, (0, 0, 4, 5), 1
)


class HonestDisk:
    """Remembers what has been synced: contents by inode, names by folder."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root = root
        self.contents: dict[int, bytes] = {}
        self.names: dict[int, dict[str, tuple[int, bool]]] = {}
        self.root_inode = root.stat().st_ino
        self.moments = 0
        self.after_sync = lambda: None
        fsync = os.fsync
        one_at_a_time = threading.RLock()  # files of a batch are synced by several threads

        def watched(handle: int) -> None:
            fsync(handle)
            with one_at_a_time:
                remember(handle)

        def remember(handle: int) -> None:
            path = Path(f"/proc/self/fd/{handle}").resolve()
            if root == path or root in path.parents:
                self._remember(handle, path)
                self.moments += 1
                self.after_sync()

        monkeypatch.setattr(os, "fsync", watched)

    def _remember(self, handle: int, path: Path) -> None:
        inode = os.fstat(handle).st_ino
        if path.is_dir():
            entries = {entry.name: (entry.inode(), entry.is_dir()) for entry in os.scandir(path)}
            self.names[inode] = entries
        else:
            self.contents[inode] = path.read_bytes()

    def after_power_cut(self, target: Path) -> Path:
        """Write what is surely on the disk into ``target``."""
        target.mkdir()
        self._write(self.root_inode, target)
        return target

    def _write(self, inode: int, target: Path) -> None:
        for name, (child, is_folder) in self.names.get(inode, {}).items():
            if is_folder:
                (target / name).mkdir()
                self._write(child, target / name)
            else:
                (target / name).write_bytes(self.contents.get(child, b""))


def test_a_power_cut_at_any_moment_leaves_every_promised_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = (tmp_path / "disk").resolve()
    root.mkdir()
    disk = HonestDisk(root, monkeypatch)
    promised: set[int] = set()
    stages: list[tuple[int, RunCondition | None]] = []

    def cut() -> None:
        copy = disk.after_power_cut(tmp_path / "copy")
        runs = [path for path in copy.iterdir() if not path.name.startswith(".")]
        assert len(runs) <= 1
        condition = None
        if runs:
            run = Run.open(runs[0])
            condition = run.condition
            assert promised <= set(run.records)
            for index in run.records:
                assert run.verify(index) is None
                assert np.all(run.frame(index) == index)
            if run.reason is FinishReason.COMPLETED:
                assert run.missing() == []
        else:
            assert not promised
        stages.append((len(promised), condition))
        shutil.rmtree(copy)

    disk.after_sync = cut
    plan = Plan(label="order", parts=(Part(label="a", repeats=6),))
    with RunWriter.create(root, label="order", bench=BENCH, plan=plan) as writer:
        writer.start()
        for batch in ([0], [1, 2, 3], [4], [5]):
            writer.write([FrameToStore(i, np.full((4, 5), i, np.uint8), METADATA) for i in batch])
            promised.update(batch)
            cut()
        writer.finish(FinishReason.COMPLETED)
    cut()
    assert disk.moments > 40
    assert {number for number, _ in stages} == {0, 1, 4, 5, 6}
    assert stages[-1] == (6, RunCondition.COMPLETED)


def test_the_test_above_can_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without syncing the chunk's folders, the frame would be promised but not there."""
    root = (tmp_path / "disk").resolve()
    root.mkdir()
    disk = HonestDisk(root, monkeypatch)
    plan = Plan(label="order", parts=(Part(label="a"),))
    with RunWriter.create(root, label="order", bench=BENCH, plan=plan) as writer:
        monkeypatch.setattr("instrument.runs.frame_array.SyncPool.folders", lambda *_: None)
        writer.write([FrameToStore(0, np.zeros((4, 5), np.uint8), METADATA)])
    (run,) = (p for p in disk.after_power_cut(tmp_path / "copy").iterdir() if p.name[0] != ".")
    try:
        found = Run.open(run).verify(0)
    except RunError:
        return
    assert found is not None
