"""The GRBL emulator under somebody else's client (pygrbl-streamer, MIT)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.mocks.grbl_controller import GrblController

SQUARE = ["G21", "G90", "G1 X-4 Y-4 F1200", "X-6", "Y-6", "X-4", "Y-4", "M5"]


@pytest.fixture(params=[False, True], ids=["grbl", "hal"])
def board(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[GrblController]:
    board = GrblController(tmp_path, hal=request.param)
    yield board
    board.unplug()


@pytest.fixture
def streamer(board: GrblController) -> Iterator[Any]:
    library = pytest.importorskip("pygrbl_streamer")
    streamer = library.GrblStreamer(str(board.link))
    streamer.connect()
    yield streamer
    streamer.disconnect()


def test_pygrbl_streamer_homes_and_streams_a_square(board: GrblController, streamer: Any) -> None:
    assert streamer.home(timeout=10, wait_idle=True)
    assert board.reported == [-1.0, -1.0, -1.0]
    assert streamer.stream(SQUARE)
    assert board.reported[:2] == [-4.0, -4.0]
    assert streamer.sync().name == "IDLE"


def test_pygrbl_streamer_stops_and_recovers(board: GrblController, streamer: Any) -> None:
    assert streamer.home(timeout=10, wait_idle=True)
    assert streamer.command("G1 X-18 F600")
    streamer.stop()  # feed hold, then reset: at rest, so that no step is lost
    assert -18 < board.reported[0] < -1
    assert board.place == board.reported
    assert streamer.reset()
    assert board.state == "Idle"


def test_pygrbl_streamer_sees_an_alarm(board: GrblController, streamer: Any) -> None:
    assert streamer.home(timeout=10, wait_idle=True)
    board.homing_alarm = 9
    assert not streamer.home(timeout=2, wait_idle=True)
    assert streamer.sync().name == "ALARM"
