"""What of a run contradicts itself, how many of its frames are safe, and the page that shows them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from instrument.runs import inspection
from instrument.runs.inspection import contact_sheet, summary, verify
from instrument.runs.log import FrameRecord, Gap
from instrument.runs.run import DamagedFrame, FinishReason, Run, RunCondition
from tests.instrument.runs.test_store import metadata


class Plan(list[Any]):
    def whole_steps(self) -> list[Any]:
        return list(self)


STEPS = Plan(SimpleNamespace(index=index, average=1, label=f"step {index}") for index in range(3))


def record(index: int, **changes: Any) -> FrameRecord:
    return FrameRecord(index, 96, 0, 1, replace(metadata(index), **changes))


def a_run(**changes: Any) -> Any:
    """Return what looking at a run asks of it: three planned frames, all written, nothing wrong."""
    facts: dict[str, Any] = {
        "plan": STEPS,
        "records": {index: record(index) for index in range(3)},
        "unlisted": {},
        "lost": {},
        "gaps": (),
        "beside": (),
        "gone": (),
        "reason": FinishReason.COMPLETED,
        "n_frames": 3,
        "has_frames": True,
        "array": SimpleNamespace(n_frames=3, frame_shape=(6, 8)),
        "bad": (),
        "log_bytes": 7,
        "condition": RunCondition.COMPLETED,
        "is_being_written": False,
        "log_is_foreign": False,
    }
    run = SimpleNamespace(**facts | changes)
    run.without_a_line = lambda: list(run.beside)
    run.missing = lambda: list(run.gone)
    run.damaged = lambda _, read, noted: run.bad if read or noted else ()
    return run


RECORDING = {"plan": None}


@pytest.mark.parametrize(
    ("changes", "problems"),
    [
        ({}, []),
        (RECORDING, []),
        ({"gone": [1]}, ["marked as completed, but frames 1 are not there"]),
        ({"gone": [1], "reason": FinishReason.STOPPED}, []),
        ({"gone": [1], "log_is_foreign": True}, []),
        (
            RECORDING | {"gone": [1, 2, 4, 5, 6, 7], "gaps": (Gap(4, 1, 1),), "lost": {6: ""}, "beside": [7]},
            ["frames 1-2 are neither stored nor accounted for as lost"],
        ),
        (RECORDING | {"gone": [9], "unlisted": {9: ""}}, []),
        ({"records": {-1: record(-1), 2: record(2), 3: record(3)}}, ["the log has frames -1, 3, beyond"]),
        ({"gaps": (Gap(0, 0, 1), Gap(2, 1, 1))}, ["frames 0, 2 are both stored and lost"]),
        (RECORDING | {"n_frames": 4}, ["the image array is for 3 frames, the log knows 4"]),
        (RECORDING | {"n_frames": 4, "reason": None}, []),
        (RECORDING | {"n_frames": 4, "has_frames": False}, []),
        ({"n_frames": 4}, []),  # a plan's array is as large as the plan
        ({"array": SimpleNamespace(n_frames=3, frame_shape=(6, 8, 3))}, []),
        ({"records": {0: record(0, roi=(0, 0, 7, 8))}}, ["frame 0: its region (0, 0, 7, 8) at binning 1 is"]),
        ({"records": {0: record(0, roi=(0, 0, 13, 17), binning=2)}}, []),
        (
            {"records": {0: replace(record(0), average=4)}},
            ["frame 0 averages 4, planned were 1"],
        ),
    ],
)
def test_what_contradicts_itself_is_said(
    changes: dict[str, Any], problems: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspection, "file_problems", lambda _: ["a file"])
    found = verify(a_run(path=tmp_path, **changes))
    assert len(found.problems) == len(problems)
    assert all(said.startswith(words) for said, words in zip(found.problems, problems, strict=True))
    assert found.files == ("a file",)


def test_frames_are_counted_and_those_to_do_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspection, "file_problems", lambda _: [])
    run = a_run(
        path=tmp_path,
        records={0: record(0), 2: record(2)},
        unlisted={8: "", 9: ""},
        bad=(DamagedFrame(2, ""),),
        beside=[5],
    )
    assert verify(run, read=False).todo == (1,)
    found = verify(run)
    assert (found.frames, found.todo, found.without_a_line) == (3, (1, 2), (5,))
    assert (found.log_bytes, found.is_recording, found.condition) == (7, False, RunCondition.COMPLETED)
    assert verify(run, read=False).todo == (1, 2), "what was damaged when it was read is noted"
    run.is_being_written, run.plan = True, None
    assert (verify(run).without_a_line, verify(run).todo, verify(run).is_recording) == ((), (), True)


def test_a_photograph_and_a_run_are_summed_up_without_reading_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.tif").write_text("")
    for simulated in (True, False):
        monkeypatch.setattr(inspection, "image_metadata", lambda _, said=simulated: {"simulated": said})
        found = summary(tmp_path / "a.tif")
        assert (found.kind, found.became, found.stored, found.frames) == ("photograph", "completed", 1, 1)
        assert found.is_simulated is simulated
    monkeypatch.setattr(inspection, "file_problems", lambda _: [])
    for gone in ([], [1]):
        run = a_run(gone=gone, label="x", path=tmp_path, is_simulated=True, error="", bad=[1 / 3])
        monkeypatch.setattr(Run, "open", lambda _, run=run: run)
        found = summary(tmp_path)
        assert found.became == ("completed, DAMAGED" if gone else "completed")
        assert (found.kind, found.is_simulated, found.problem) == ("plan", True, "")


def test_a_page_shows_twelve_frames_spread_evenly_and_what_is_saturated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages: list[tuple[Figure, Path]] = []
    monkeypatch.setattr(inspection, "save_figure", lambda figure, path: pages.append((figure, path)))
    monkeypatch.setattr(inspection, "as_seen", lambda frame, raw: np.where(frame > 51, 102, 51) * raw)
    frames = np.zeros((30, 6, 1280), np.uint16)
    frames[:, 2:, 0] = 62  # of six significant bits; full scale is 63
    frames[:, 4:, 0] = 63
    run = a_run(
        records={index: record(index, significant_bits=6) for index in range(30)},
        n_frames=31,
        path=tmp_path / "run",
        is_simulated=True,
        frame=lambda index: frames[index],
        metadata=lambda index: run.records[index].metadata,
        steps=lambda: STEPS,
    )
    assert contact_sheet(run, tmp_path / "a.png", leave_out=range(1)) == [
        1, 4, 6, 9, 11, 14, 16, 19, 21, 24, 26, 29,
    ]  # fmt: skip
    assert contact_sheet(run, tmp_path / "b.png", leave_out=range(30)) == []
    ((figure, path),) = pages
    assert path == tmp_path / "a.png"
    assert figure.get_suptitle() == "run: completed, 29 of 31 frames  SIMULATED  (red: saturated)"
    np.testing.assert_allclose(figure.get_size_inches(), (12.8, 9.2))
    assert len(figure.axes) == 12
    specs = [axes.get_subplotspec() for axes in figure.axes]
    assert [(spec.get_geometry()[:2], spec.num1) for spec in specs if spec] == [
        ((3, 4), place) for place in range(12)
    ]
    assert figure.axes[0].get_title() == "1 step 1  10 ms\noff"
    assert figure.axes[1].get_title() == "4   10 ms\noff"
    assert figure.axes[0].title.get_fontsize() == 8
    assert not figure.axes[0].axison
    picture = figure.axes[0].images[0].get_array()
    assert picture is not None
    assert picture.shape == (3, 640, 3)
    np.testing.assert_allclose(picture[:, 0], [(0.2,) * 3, (0.4,) * 3, (1, 0, 0)])
    assert inspection._shown(run, 1).max() == 1

    run.frame = lambda _: np.stack([frames[0, :, :320]] * 2 + [frames[0, :, 320:640]], axis=2)
    monkeypatch.setattr(inspection, "as_seen", lambda frame, raw: np.full(frame.shape, 51))
    run.plan, run.is_simulated = None, False
    assert contact_sheet(run, tmp_path / "c.png", leave_out=range(1, 25)) == [0, 25, 26, 27, 28, 29]
    figure = pages[1][0]
    assert "SIMULATED" not in figure.get_suptitle()
    assert (len(figure.axes), figure.axes[0].get_title()) == (6, "0   10 ms\noff")
    np.testing.assert_allclose(figure.get_size_inches(), (12.8, 6.3))
    picture = figure.axes[0].images[0].get_array()
    assert picture is not None
    assert picture.shape == (6, 320, 3)
    np.testing.assert_allclose(picture[:, 0], [(0.2,) * 3] * 4 + [(1, 0, 0)] * 2, rtol=1e-6)
