"""What a run begins with and how one that needs no bench is closed, without a disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import pytest

from instrument.plan import Plan
from instrument.runs import acquire
from instrument.runs.acquire import abilities_of, prepare, prepare_resume, settle
from instrument.runs.run import FinishReason, RunCondition
from instrument.runs.run_files import SLM_IMAGES, RunError
from tests.instrument.runs.test_runner import open_mock_bench, plan

CUT = (FinishReason.ABORTED, "its program ended without finishing it")


def found(
    condition: RunCondition, *, recording: bool, sound: bool = False, todo: tuple[int, ...] = ()
) -> Any:
    damaged = [SimpleNamespace(index=3, problem="is gone")]
    facts = {"condition": condition, "is_recording": recording, "is_as_written": sound, "todo": todo}
    return SimpleNamespace(**facts, damaged=damaged, log_bytes=9, files=())


@pytest.fixture
def writer(monkeypatch: pytest.MonkeyPatch) -> Any:
    made = MagicMock(mended=("a file",), settle=Mock(return_value=["a frame"]))
    made.__enter__.return_value = made
    monkeypatch.setattr(acquire.RunWriter, "reopen", Mock(return_value=made))
    monkeypatch.setattr(acquire.Run, "open", lambda _: SimpleNamespace(error="no space"))
    return made


@pytest.mark.parametrize(
    ("condition", "recording", "closed", "end"),
    [
        (RunCondition.CRASHED, True, "the recording was cut off; it is closed now", CUT),
        (RunCondition.FAILED, True, "", (FinishReason.FAILED, "no space")),
        (RunCondition.COMPLETED, True, "", (FinishReason.COMPLETED, "no space")),
        (RunCondition.CRASHED, False, "the run was cut off; it is closed now", (FinishReason.COMPLETED, "")),
        (RunCondition.ABORTED, False, "the run was aborted; it is closed now", (FinishReason.COMPLETED, "")),
        (RunCondition.COMPLETED, False, "", (FinishReason.COMPLETED, "")),
    ],
)
def test_a_run_that_needs_no_frame_is_mended_closed_and_said(
    condition: RunCondition, recording: bool, closed: str, end: tuple[object, str], writer: Any
) -> None:
    words = settle("runs/one", found(condition, recording=recording))
    assert words == ["a file", "a frame", *([closed] if closed else [])]
    writer.settle.assert_called_once_with({3: "is gone"})
    writer.finish.assert_called_once_with(*end)
    assert writer.note.call_args.kwargs["text"].endswith("\n  ".join(words))


def test_what_is_sound_and_ended_is_left_as_it_is(writer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for recording, condition in ((True, RunCondition.FAILED), (False, RunCondition.COMPLETED)):
        monkeypatch.setattr(acquire, "look", lambda _, it=(condition, recording): found(
            it[0], recording=it[1], sound=True
        ))  # fmt: skip
        assert settle("runs/one") == []
    assert settle("runs/one", found(RunCondition.CRASHED, recording=True, sound=True)) != []
    with pytest.raises(RunError, match="2 frames of its plan are still to be taken"):
        settle("runs/one", found(RunCondition.CRASHED, recording=False, todo=(1, 2)))
    with pytest.raises(RunError, match="only runs of a plan"):
        prepare_resume(Mock(), "runs/one", found(RunCondition.CRASHED, recording=True))
    assert writer.finish.call_count == 1


@pytest.mark.usefixtures("mock_drivers")
def test_a_run_is_made_in_the_folder_named_else_in_the_bench_s_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders: list[Path] = []

    def create(folder: Path, **_: object) -> Any:
        folders.append(folder)
        return Mock(path=folder, mended=())

    checked, control = Mock(), Mock()
    monkeypatch.setattr(acquire, "check", checked)
    monkeypatch.setattr(acquire.RunWriter, "create", create)
    with open_mock_bench() as bench:
        runner = prepare(bench, plan(1), str(tmp_path), control=control)
        prepare(bench, plan(1))
        assert folders == [tmp_path, bench.config.data_folder]
    assert checked.call_count == 2
    control.follow.assert_called_once_with(runner)


def test_an_slm_is_read_where_there_is_one() -> None:
    slm = SimpleNamespace(shape=(4, 6), settle_ms=7.0)
    for there, expected in ((slm, ((4, 6), 7.0)), (None, (None, 0.0))):
        abilities = abilities_of(MagicMock(slm=there))
        assert (abilities.slm_shape, abilities.slm_settle_ms) == expected


def test_a_run_whose_slm_image_is_another_is_not_gone_on_with(
    writer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_it = MagicMock(spec=Plan, slm_images=(Path("runs/one/slm/a.png"),))
    monkeypatch.setattr(acquire.Run, "open", lambda _: SimpleNamespace(plan=of_it))
    with pytest.raises(RunError, match="not the image that the run began with"):
        prepare_resume(Mock(), "runs/one", found(RunCondition.CRASHED, recording=False, todo=(1,)))
    writer.close.assert_called_once_with()


@pytest.mark.parametrize("homed", [False, True])
def test_a_stage_says_where_it_is_when_it_is_homed(homed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = SimpleNamespace(axes=("x",), position=lambda: {"x_um": 3.0}, is_homed=homed)
    abilities = abilities_of(MagicMock(stage=stage))
    assert (abilities.stage_axes, abilities.stage_position) == (("x",), {"x_um": 3.0})
    assert abilities.stage_homed == homed
    monkeypatch.setattr(acquire, "camera_settings", lambda _: {})
    for there, expected in ((stage, {"x_um": 3.0} if homed else {}), (None, {})):
        bench = MagicMock(stage=there, devices={})
        assert acquire.record_of(bench).stage == expected


def test_a_bench_without_stage_and_lights_is_read_too() -> None:
    abilities = abilities_of(MagicMock(stage=None, led_array=None))
    assert (abilities.stage_axes, abilities.stage_position, abilities.stage_homed) == ((), {}, True)
    assert (abilities.n_leds, abilities.stage_target) == (0, None)


def test_a_real_camera_beside_a_simulated_stage_takes_its_time() -> None:
    world = SimpleNamespace(options=SimpleNamespace(time_scale=0.0))
    for simulated, expected in ((("stage",), 1.0), (("camera", "stage"), 0.0)):
        config = SimpleNamespace(shared={"simulated": world})
        bench: Any = MagicMock(config=config, devices={"camera": 1, "stage": 2}, simulated_kinds=simulated)
        assert acquire.time_scale(bench) == expected


@pytest.mark.parametrize(
    ("damaged", "there", "todo", "refused"),
    [
        ((), True, (1,), False),
        ((), False, (), False),
        ((), True, (), False),
        ((), False, (1,), True),
        ((f"{SLM_IMAGES}/a.png",), True, (), True),
        (("other.png",), True, (1,), False),
    ],
)
def test_an_slm_image_is_asked_for_where_it_is_to_be_shown(
    damaged: tuple[str, ...], there: bool, todo: tuple[int, ...], refused: bool, tmp_path: Path
) -> None:
    image = tmp_path / "a.png"
    if there:
        image.touch()
    findings: Any = SimpleNamespace(files=[SimpleNamespace(name=name) for name in damaged], todo=todo)
    if refused:
        with pytest.raises(RunError, match="not the image that the run began with"):
            acquire._require_slm_images(findings, MagicMock(slm_images=[image]))
    else:
        acquire._require_slm_images(findings, MagicMock(slm_images=[image]))


def test_what_goes_on_is_checked_from_where_it_is_with_the_camera_as_it_was(
    writer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = SimpleNamespace(
        plan=MagicMock(slm_images=()), provenance={"camera": {"gain": 2}}, path="p", start={}
    )
    checked, restored = Mock(), Mock()
    monkeypatch.setattr(acquire.Run, "open", lambda _: run)
    for name, value in (("check", checked), ("restore_camera", restored), ("Runner", Mock())):
        monkeypatch.setattr(acquire, name, value)
    monkeypatch.setattr(acquire, "abilities_of", lambda *_: "abilities")
    bench = Mock()
    prepare_resume(bench, "runs/one", found(RunCondition.CRASHED, recording=False, todo=(1,)))
    checked.assert_called_once_with(run.plan, "abilities", todo=(1,), start={})
    restored.assert_called_once_with(bench.camera, {"gain": 2})
    assert writer.note.call_args.kwargs["text"].endswith("a file")
    monkeypatch.setattr(acquire.Run, "open", lambda _: SimpleNamespace(path="p", is_being_written=True))
    with pytest.raises(RunError, match="another program is writing to this run"):
        acquire.look("runs/one")
