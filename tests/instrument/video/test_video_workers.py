"""Blocks of a video by threads, processes and clusters: the same pictures, none lost, whoever computes."""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import signal
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from instrument.cli import main
from instrument.files.errors import BenchError, FileError
from instrument.reconstruction import video_work as block_module
from instrument.reconstruction.video import (
    finish_video,
    prepare_video,
    solve_video,
)
from instrument.reconstruction.video_work import BlockReport, cluster, on_cluster
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.solvers.sensor_admm import SensorAdmm
from recon.streams.video import VideoSolver
from tests.instrument.video.recorded import assert_same, pictures, request, solved


def test_a_file_error_of_a_worker_process_arrives_whole() -> None:
    error = FileError("a.npy", "is damaged.", "Mend it.")
    arrived = pickle.loads(pickle.dumps(error))
    assert (type(arrived), str(arrived), arrived.path) == (FileError, str(error), error.path)


def test_blocks_solved_together_are_in_memory_one_after_the_other(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once: list[int] = []
    present: set[int] = set()
    threads: list[int] = []

    def solve(_folder: str, _out: str, number: int, **_: object) -> BlockReport:
        present.add(number)
        time.sleep(0.05)
        at_once.append(len(present))
        present.remove(number)
        return BlockReport(number, 0, 0, 0.0)

    monkeypatch.setattr("instrument.reconstruction.video_work.get_threads", lambda: 4)
    monkeypatch.setattr("instrument.reconstruction.video_work.set_threads", threads.append)
    monkeypatch.setattr("instrument.reconstruction.video_work.solve_block", solve)
    prepared = prepare_video(request(recording, tmp_path, over_time="tv"))
    assert solve_video(prepared, lambda _: None, threading.Event())
    assert (at_once, threads) == ([1, 1, 1], [4, 4])


def test_blocks_solved_together_hold_no_other_solver(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_module, "VideoSolver", None)
    wanted = request(recording, tmp_path, over_time="tv", options=ReconstructionOptions(iterations=2))
    assert solved(wanted)


@pytest.mark.slow
def test_workers_take_the_weight_that_the_first_frame_told(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = prepare_video(request(recording, tmp_path))

    def anew(_: Problem) -> None:
        raise AssertionError("a worker looked again")

    blas = []
    move = SensorAdmm.set_data

    def set_data(solver: SensorAdmm, data: np.ndarray) -> None:
        blas.append(max(found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"))
        move(solver, data)

    with monkeypatch.context() as patched, threadpool_limits(2):
        patched.setattr("recon.streams.video.look_at", anew)
        patched.setattr(SensorAdmm, "set_data", set_data)
        block_module.solve_block(str(prepared.job.folder), str(prepared.request.out), 0)
    assert set(blas) == {1}  # its threads would wait for one another by spinning
    told = prepared.job.plan.settings["weight"]
    with VideoSolver(prepared.job.problem) as again:
        assert told == pytest.approx(max(again.weights), rel=1e-12)
    with VideoSolver(prepared.job.problem, times_noise=prepared.job.times_noise) as again:
        assert told == pytest.approx(max(again.weights), rel=1e-12)


def test_a_cluster_here_takes_work_from_its_owner_only() -> None:
    pytest.importorskip("cryptography", reason="a cluster's keys need cryptography")
    distributed = pytest.importorskip("distributed")
    with cluster(workers=1) as client:
        addresses = [client.scheduler_info()["address"], *client.scheduler_info()["workers"]]
        assert all(address.startswith("tls://127.0.0.1:") for address in addresses)
        assert client.submit(abs, -1).result() == 1
        for scheme, security in (("tcp", None), ("tls", distributed.Security.temporary())):
            address = addresses[0].replace("tls", scheme)
            with pytest.raises(OSError):  # noqa: PT011 # which, is Dask's
                distributed.Client(address, security=security, timeout=1)
        known = client.scheduler_info()
        ports = [port for one in (known, *known["workers"].values()) for port in one["services"].values()]
        assert ports
        assert 8787 not in ports  # another cluster's, as a rule
        for port in ports:
            with socket.create_connection(("127.0.0.1", port), timeout=10) as page:
                page.sendall(b"GET /info/main/workers.html HTTP/1.0\r\n\r\n")
                assert b" 404 " in page.recv(100)


@pytest.mark.slow
def test_the_same_on_a_cluster_that_loses_a_worker(
    recording: Path, video: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("cryptography", reason="a cluster's keys need cryptography")
    wanted = request(recording, tmp_path)
    prepared = prepare_video(wanted)
    reports: list[BlockReport] = []
    with cluster(workers=2) as client:
        pids = client.run(os.getpid)

        def told(report: BlockReport) -> None:
            reports.append(report)
            if len(reports) == 1:
                os.kill(next(iter(pids.values())), signal.SIGKILL)

        on_cluster(client, prepared.job.folder, wanted.out, prepared.left, told, threading.Event())
    assert sorted(report.block for report in reports) == [0, 1, 2]
    assert sum(report.written for report in reports) <= 10
    assert not prepared.left
    assert not [record for record in caplog.records if record.name.startswith("distributed")]
    finish_video(prepared)
    assert_same(pictures(tmp_path), pictures(video))


def test_workers_that_are_lost_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    distributed = pytest.importorskip("distributed")

    class Future:
        asked = 0

        def done(self) -> bool:
            self.asked += 1
            return self.asked > 2

        def result(self) -> BlockReport:
            raise distributed.KilledWorker("block", None, 3)

    class Client:
        crews = iter([{"a", "b"}, {"b", "c"}, {"c"}])
        cancelled: list[object] | None = None

        def submit(self, *_: object, **__: object) -> Future:
            return Future()

        def nthreads(self) -> dict[str, int]:
            return dict.fromkeys(next(self.crews), 1)

        def cancel(self, left: list[object]) -> None:
            self.cancelled = left

    client, told = Client(), list[int]()
    with pytest.raises(BenchError, match="Every worker that took one of the blocks was lost"):
        on_cluster(client, tmp_path, tmp_path, [0], lambda _: None, threading.Event(), told.append)
    assert told == [1, 1]
    assert len(client.cancelled or ()) == 1
    assert [record.getMessage().split(":")[0] for record in caplog.records] == [
        "1 worker ended or cannot be reached"
    ] * 2


@pytest.mark.parametrize(
    ("raised", "cause", "said"),
    [
        (RuntimeError("Error during deserialization of the task graph."), ImportError("No 'instrument'"), 1),
        (ModuleNotFoundError("No 'instrument'"), None, 1),
        (RuntimeError("a block's own"), None, 0),
    ],
)
def test_a_scheduler_or_worker_without_this_program_is_said(
    tmp_path: Path, raised: Exception, cause: Exception | None, said: int
) -> None:
    class Future:
        def done(self) -> bool:
            return True

        def result(self) -> None:
            raise raised from cause

    class Client:
        def submit(self, *_: object, **__: object) -> Future:
            return Future()

        def nthreads(self) -> dict[str, int]:
            return {}

        def cancel(self, left: list[Future]) -> None:
            assert left

    expected, words = (
        (BenchError, "cannot read what it is given: No 'instrument'. Start both")
        if said
        else (
            RuntimeError,
            "a block's own",
        )
    )
    with pytest.raises(expected, match=words):
        on_cluster(Client(), tmp_path, tmp_path, [0], lambda _: None, threading.Event())


def test_a_scheduler_that_ends_is_said(tmp_path: Path) -> None:
    pytest.importorskip("distributed")

    class Future:
        def done(self) -> bool:
            return False

    class Client:
        def submit(self, *_: object, **__: object) -> Future:
            return Future()

        def nthreads(self) -> dict[str, int]:
            raise OSError("ConnectionPool closing.")

        def cancel(self, _: object) -> None:
            pass

    with pytest.raises(BenchError, match=r"The cluster's scheduler ended.*the same command goes on"):
        on_cluster(Client(), tmp_path, tmp_path, [0], lambda _: None, threading.Event())


def test_workers_that_are_there_are_not_told_as_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    numbers = iter(range(9))

    def solved(*_: object, **__: object) -> BlockReport:
        time.sleep(1)
        return BlockReport(next(numbers), 1, 1, 1.0)

    # A client asks by itself, without the workers, and keeps that answer as the last one.
    often = {"distributed.client.scheduler-info-interval": "1ms"}
    monkeypatch.setattr(block_module, "solve_block", solved)
    monkeypatch.setattr(block_module, "_POLL_S", 0.01)
    lost: list[int] = []
    with (
        importlib.import_module("dask.config").set(often),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
        ) as here,
        distributed.Client(here) as client,
    ):
        on_cluster(client, tmp_path, tmp_path, [0, 1], lambda _: None, threading.Event(), lost.append)
    assert lost == []


def test_a_scheduler_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("instrument.reconstruction.video_work.CONNECT_S", 1)
    with pytest.raises(BenchError, match="No Dask scheduler answers"), cluster(scheduler="tcp://127.0.0.1:9"):
        pass


def test_a_scheduler_of_somebody_else_is_refused_unless_named(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    class Dask:
        @staticmethod
        def Client(address: str, **_: object) -> contextlib.AbstractContextManager[str]:
            asked.append(address)
            return contextlib.nullcontext(address)

    monkeypatch.setattr(block_module, "_dask", lambda: Dask)
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        address = f"tcp://localhost:{listener.getsockname()[1]}"
        with cluster(scheduler=address):
            assert asked == [address]
        with pytest.raises(BenchError, match="not eve's"), cluster(scheduler=address, owner="eve"):
            pass
        monkeypatch.setattr(block_module, "_listening", lambda _: {"eve"})
        with pytest.raises(BenchError, match=r"is eve's.*--scheduler-owner"), cluster(scheduler=address):
            pass
        with cluster(scheduler=address, owner="eve"):
            pass
    with pytest.raises(BenchError, match="nothing says the owner of"), cluster(scheduler="10.0.0.1:8786"):
        pass
    with cluster(scheduler="tcp://10.0.0.1:8786", owner="ann"), cluster(scheduler="tls://10.0.0.1:8786"):
        pass
    for wrong in ("tcp://", "tcp://a:b", "x" * 9):
        with pytest.raises(BenchError, match="No Dask scheduler"), cluster(scheduler=wrong):
            pass
    assert len(asked) == 4


def test_an_unknown_scheduler_leaves_nothing_behind(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("instrument.reconstruction.video_work.CONNECT_S", 1)
    arguments = ["reconstruct", str(recording), "--video", "--psf", str(recording.parent / "psf.npy")]
    out = ["--out", str(tmp_path / "s.ome.zarr"), "--scheduler", "tcp://127.0.0.1:9"]
    assert main([*arguments, "--dark", "20", *out]) == 2
    assert "No Dask scheduler answers" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
