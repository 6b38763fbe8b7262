"""What mending a run finds wrong of its state, what it keeps beside, and that it is on the disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from instrument.runs import repair
from instrument.runs.repair import keep_beside, mend_files
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import PROVENANCE
from tests.instrument.runs.test_store import frame, new_run

LOG_SAYS = {"label": "a", "simulated": True, "id": "1", "state": "finished", "reason": "completed"}


def said(state: Mapping[str, Any], log_says: Mapping[str, Any] = LOG_SAYS, *, copied: bool = True) -> str:
    """Return what is said of a state beside what the log says."""
    run: Any = SimpleNamespace(
        state=state,
        state_problem="",
        state_by_log=lambda: log_says,
        files=SimpleNamespace(copies={PROVENANCE: "{}"} if copied else {}),
    )
    problem = repair._state_problem(run)
    return "" if problem is None else str(problem)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"label": "b"}, "label is 'b', not 'a'"),
        ({"simulated": False}, "simulated is False, not True"),
        ({"id": "2", "label": "b"}, "label is 'b', not 'a'; id is '2', not '1'"),
        ({"id": None}, "id is None, not '1'"),
        ({"reason": "stopped"}, "reason is 'stopped', not 'completed'"),
        ({"state": "running", "reason": None}, ""),  # one of the two has not ended
        ({"error": "of which nothing is held against the log"}, ""),
    ],
)
def test_a_state_is_held_against_the_log(changes: Mapping[str, Any], words: str) -> None:
    found = said({**LOG_SAYS, **changes})
    assert found == (f"state.json: says what the log does not: {words}" if words else "")


def test_what_the_log_does_not_tell_is_not_held_against_it() -> None:
    running = {name: value for name, value in LOG_SAYS.items() if name != "reason"} | {"state": "running"}
    assert said({**LOG_SAYS, "reason": "stopped"}, running) == ""
    without = {name: value for name, value in LOG_SAYS.items() if name != "id"}
    assert said(LOG_SAYS, without) == "", "of before runs had identifiers"
    assert said({**LOG_SAYS, "label": "b"}, copied=False) == "", "an older run's log has no copies"


def test_a_state_that_lies_is_made_again_and_the_lie_kept(tmp_path: Path) -> None:
    with new_run(tmp_path) as writer:
        writer.start(steps=5)
        writer.write([frame(i) for i in range(5)])
        path = writer.finish(FinishReason.COMPLETED).path
    names = "label", "id", "simulated", "state", "reason", "finished_utc"
    whole = json.loads((path / "state.json").read_text())
    lie = json.dumps({**whole, "label": "another", "reason": "failed"})
    (path / "state.json").write_text(lie)
    said = mend_files(path)
    assert [line.partition(";")[0] for line in said] == ["state.json was made again"]
    assert [Run.open(path).state[name] for name in names] == [whole[name] for name in names]
    assert [kept.read_text() for kept in (path / "kept").iterdir()] == [lie]
    assert mend_files(path) == []


def test_what_is_kept_beside_is_surely_on_the_disk_and_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    monkeypatch.setattr(repair, "sync_folder", synced.append)
    places = []
    for text in ("one", "other"):
        (tmp_path / "a" / "b").mkdir(parents=True, exist_ok=True)
        (tmp_path / "a" / "b" / "c").write_text(text)
        places.append(keep_beside(tmp_path, "a/b/c"))
        assert not (tmp_path / "a" / "b" / "c").exists()
    assert [place.read_text() for place in places] == ["one", "other"]
    assert {place.parent for place in places} == {tmp_path / "kept"}
    assert synced == [tmp_path, tmp_path / "kept", tmp_path / "kept"]
    data = keep_beside(tmp_path, "d", b"cut out")
    assert data.read_bytes() == b"cut out"
    assert data.name.endswith("_d")
