"""A routine's first run told beforehand: carried out on a simulated bench of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from numba.core import event

from calibration_routines import rehearsal
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.rehearsal import ENOUGH_S, rehearse_whole
from calibration_routines.routine import Routine, routines
from drivers.errors import DeviceError
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.files.errors import duration
from instrument.runs.rehearsal import twin_of
from instrument.runs.run_control import RunControl
from instrument.runs.runner import RunState, RunStatus
from tests.mocks.listeners import Following

TINY = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[simulated]
preset = "tiny"
time_scale = 1.0
"""
LIT = """
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
"""


@dataclass(frozen=True, slots=True)
class Asked:
    """Options of a routine."""

    out: Path | None = None
    again: Path | None = None


@pytest.fixture
def bench() -> Iterator[Bench]:
    with open_bench(parse_config(TINY, None)) as opened:
        yield opened


class Hands:
    """A clock that only goes on when told."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def perf_counter(self) -> float:
        return self.now_s


@pytest.fixture
def hands(monkeypatch: pytest.MonkeyPatch) -> Hands:
    made = Hands()
    monkeypatch.setattr(rehearsal, "time", SimpleNamespace(perf_counter=made.perf_counter))
    return made


Deed = Callable[[Bench, RunControl, Listener, Asked], None]


def routine(deed: Deed) -> Routine:
    @dataclass(frozen=True, slots=True)
    class Doing(Procedure):
        asked: Asked

        def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
            return Outlook()

        def perform(
            self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener
        ) -> Outcome:
            deed(bench, control, listener, self.asked)
            return Outcome((), good=True)

    return Routine(name="deed", title="Deed", help="Do.", options=Asked, procedure=Doing)


Work = tuple[tuple[str, float], ...]


def told(deed: Deed, bench: Bench, asked: Asked | None = None, work: Work = ()) -> tuple[str, ...]:
    return rehearse_whole(routine(deed), asked or Asked(), bench, lambda done, total: None, work)


def test_all_of_it_is_told_with_the_waiting_that_was_left_out(
    bench: Bench, hands: Hands, tmp_path: Path
) -> None:
    """Homing is not waited for there, and nothing is done or written here."""

    def deed(twin: Bench, _control: RunControl, listener: Listener, asked: Asked) -> None:
        assert twin.stage is not None
        listener.step("homing the stage")
        twin.stage.home()
        twin.stage.move_to({"x_um": 1000.0})
        hands.now_s += 2.0
        listener.step("analysing")
        with event.trigger_event("numba:compile"):
            hands.now_s += 10.0
            with event.trigger_event("numba:compile"):  # one that it calls
                hands.now_s += 10.0
        hands.now_s += 3.0
        assert asked.out is not None
        asked.out.write_text("result")

    (words,) = told(deed, bench, Asked(out=tmp_path / "result.json"))
    assert words.startswith("In all, by a rehearsal")
    seconds = float(words.split("about ")[1].split(" s")[0])
    assert 6.05 < seconds < 10  # 5 of computing, the stage's way, the second on its reference; no compiling
    assert bench.stage is not None
    assert not bench.stage.is_homed
    assert not list(tmp_path.iterdir())


def test_a_long_one_is_ended_and_told_by_how_far_it_came(bench: Bench, hands: Hands) -> None:
    def deed(_twin: Bench, control: RunControl, listener: Listener, _asked: Asked) -> None:
        hands.now_s += 4.0
        listener.step("solving")
        hands.now_s += 10 * ENOUGH_S  # the first one compiles
        for done in range(1, 101):
            hands.now_s += ENOUGH_S / 10
            listener.share(done, 100)
            control.check()

    (words,) = told(deed, bench)
    assert f"about {(4 + 20 * ENOUGH_S) / 60:.0f} min" in words
    assert "comes on top" in words
    assert hands.now_s < 13 * ENOUGH_S


def test_what_follows_a_step_in_which_a_rehearsal_ends_is_told_by_its_work(
    bench: Bench, hands: Hands
) -> None:
    """As quick as the work of the steps before it; what is no such work, as homing, does not count for it."""

    def deed(_twin: Bench, control: RunControl, listener: Listener, _asked: Asked) -> None:
        listener.step("homing the stage")
        hands.now_s += 5.0
        for step in ("finding", "showing", "solving"):
            listener.step(step)
            for done in range(1, 101):
                hands.now_s += 0.1 if step == "finding" else 0.5
                listener.share(done, 100)
                control.check()

    work = (("finding", 20.0), ("showing", 100.0), ("solving", 60.0))
    (words,) = told(deed, bench, work=work)
    assert words.startswith("In all, by a rehearsal up to")
    assert 'of "showing" and the sizes of what follows' in words
    assert f"about {duration(5 + 10 + 50 + 60 * 60 / 120)}." in words
    (words,) = told(deed, bench, work=work[:1])  # this step is none whose work is known
    assert words.startswith("Up to the end of")


def test_exposures_are_waited_for_and_not_scaled_by_the_work(
    bench: Bench, hands: Hands, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three seconds a picture are the camera's: the solving that follows does not wait for them."""
    waited = [0.0]
    monkeypatch.setattr(rehearsal, "not_waited_s", lambda _: waited[0])

    def deed(_twin: Bench, control: RunControl, listener: Listener, _asked: Asked) -> None:
        listener.step("showing")
        for done in range(1, 1001):
            hands.now_s, waited[0] = hands.now_s + 1.0, waited[0] + 3.0
            listener.share(done, 1000)
            control.check()

    (words,) = told(deed, bench, work=(("showing", 1000.0), ("solving", 1000.0)))
    assert f"about {duration(1000 * (1 + 3) + 1000)}." in words


def test_one_slow_part_is_not_taken_for_all(bench: Bench, hands: Hands) -> None:
    """As of an SLM's table, whose third picture computes what all others find."""

    def deed(_twin: Bench, control: RunControl, listener: Listener, _asked: Asked) -> None:
        listener.step("measuring")
        for done in range(1, 42):
            hands.now_s += 2 * ENOUGH_S if done == 3 else 0.1
            listener.share(done, 41)
            control.check()

    (words,) = told(deed, bench)
    assert words.startswith("In all")
    assert f"about {2 * ENOUGH_S + 4:.1f} s" in words


def test_slides_are_counted_and_not_their_frames(bench: Bench, hands: Hands) -> None:
    def deed(_twin: Bench, control: RunControl, listener: Listener, _asked: Asked) -> None:
        for number in range(9):
            listener.step(f"photographing slide {number + 1} of 9")
            control.check()
            for done in range(10):
                listener.frame(RunStatus(RunState.RUNNING, done, 10))
            hands.now_s += ENOUGH_S

    (words,) = told(deed, bench)
    assert f"about {9 * ENOUGH_S / 60:.0f} min" in words
    assert '"photographing slide"' in words


def test_ctrl_c_in_a_rehearsal_tells_of_no_frames_that_went_with_it(bench: Bench) -> None:
    interruption = KeyboardInterrupt()
    interruption.add_note("led_array: was unplugged.")

    def interrupted(folder: Path) -> None:
        interruption.add_note(f"To go on: diffuserbench resume {folder}/run")
        raise interruption

    with pytest.raises(KeyboardInterrupt), twin_of(bench) as made:
        interrupted(made[1] if made is not None else Path())
    assert interruption.__notes__ == ["led_array: was unplugged."]


def test_what_cannot_be_rehearsed_is_not_told(bench: Bench, tmp_path: Path) -> None:
    """Kept frames that are seen again would be added to; what fails there is said where it is done."""

    def fails(_twin: Bench, _control: RunControl, _listener: Listener, _asked: Asked) -> None:
        raise DeviceError("camera", "does not answer")

    assert told(fails, bench) == ()
    assert told(lambda *_: pytest.fail("It was carried out."), bench, Asked(again=tmp_path)) == ()


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        ("axial", {"z_min_um": 80e3, "z_max_um": 120e3, "planes": 2}),
        ("angular", {"z_um": 80e3, "largest_deg": 4.0, "step_deg": 2.0}),
        ("stage", {"turns": 2}),
    ],
)
def test_routines_that_move_the_source_tell_the_work_of_the_steps_that_they_take(
    tmp_path: Path, name: str, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    following = Following()
    lit = TINY.replace("1.0", "0.0") + LIT
    with open_bench(parse_config(lit, None)) as bench:
        procedure = routines[name].asked(asked)
        work = procedure.outlook(bench).work
        procedure.carry_out(bench, tmp_path, listener=following)
        monkeypatch.setattr(Bench, "simulated_kinds", ())
        assert not procedure.outlook(bench).work  # it has simulated light
    assert [step for step in following.steps if step in dict(work)] == [step for step, _ in work]
    assert work[-1][0] == following.steps[-1] == "analysing"
    assert all(transforms > 0 for _, transforms in work)


def test_of_beads_solving_is_told_by_what_it_computes(bench: Bench) -> None:
    work, less = (
        dict(routines["beads"].asked({"binning": n, "z_um": 1e5}).outlook(bench).work) for n in (2, 4)
    )
    assert list(work) == ["photographing bead slide", "blind deconvolution"]
    assert work["photographing bead slide"] == less["photographing bead slide"] > 0
    assert work["blind deconvolution"] == pytest.approx(5409, rel=0.3), "measured, nine slides of tiny"
    assert less["blind deconvolution"] == pytest.approx(1372, rel=0.3)
