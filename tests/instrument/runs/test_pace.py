"""A plan's time with what frames took beside exposure and motion in a run before, on the same bench."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import DeviceError
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.files import kept_times
from instrument.plan import SOURCE, BenchAbilities, Part, Plan, SourceGrid, estimate
from instrument.runs import rehearsal
from instrument.runs.acquire import abilities_of, acquire
from instrument.runs.pace import Pace, _measured, keep_pace, pace_of
from instrument.runs.rehearsal import rehearse, rehearsed
from instrument.runs.run import Run
from instrument.runs.runner import Runner, RunState, RunStatus

TOML = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
"""


def plan_of(label: str, frames: int) -> Plan:
    return Plan(label=label, parts=(Part(label="dark", repeats=frames, exposures_ms=(20.0,)),))


def test_the_pace_of_a_run_before(tmp_path: Path) -> None:
    with open_bench(parse_config(TOML, None)) as bench:
        abilities, toml = abilities_of(bench, tmp_path), bench.config.text
        assert pace_of(plan_of("a", 9), abilities, tmp_path / "none", toml) is None
        run = acquire(bench, plan_of("a", 5), tmp_path)
        other = acquire(bench, plan_of("b", 4), tmp_path)
        acquire(bench, plan_of("a", 2), tmp_path)  # too short to tell
    found = pace_of(plan_of("a", 9), abilities, tmp_path, toml)
    assert found is not None
    assert found.run == run.path.name
    times_s = [1e-9 * run.metadata(index).host_time_ns for index in range(5)]
    assert abs(found.frame_s - max((times_s[-1] - times_s[0]) / 4 - 0.02, 0.0)) < 1e-6
    unlike = pace_of(plan_of("c", 9), abilities, tmp_path, toml)
    assert unlike is not None
    assert unlike.run == other.path.name
    assert pace_of(plan_of("a", 9), abilities, tmp_path, toml + "# changed\n") is None
    assert "as in r: about 10.2 s." in Pace(1.0, "r").words(plan_of("a", 10), abilities)


def test_three_frames_at_one_go_tell_a_pace_and_a_pause_or_a_second_start_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_bench(parse_config(TOML, None)) as bench:
        abilities, toml = abilities_of(bench, tmp_path), bench.config.text
        run = acquire(bench, plan_of("a", 3), tmp_path)
    found = pace_of(plan_of("a", 9), abilities, tmp_path, toml)
    assert found is not None
    assert found.run == run.path.name
    events = list(run.events)
    for more in ("paused", "started"):
        monkeypatch.setattr(run, "events", [*events, {"kind": more}])
        assert _measured(run, abilities, toml) is None
    monkeypatch.setattr(run, "events", events)
    assert _measured(run, abilities, toml) == found


def sweep_and_scene() -> Plan:
    return Plan(
        label="sweep",
        parts=(
            Part(label="dark", exposures_ms=(20.0,)),
            Part(
                label="psf",
                light=SOURCE,
                positions=SourceGrid(z_um=(1e5, 1.5e5, 2e5, 2.5e5, 2.9e5)),
                exposures_ms=(5.0, 10.0),
            ),
            Part(label="scene", scene_lit=True, repeats=9, interval_s=3600.0),
        ),
    )


class SlowRunner(Runner):
    """A runner whose frames take 4 s in a new place, 1 s elsewhere, and 20 s for the scene's first."""

    def execute(self) -> Run:
        done = 0
        moved, scenes = set(), 0
        for step in self._plan.steps():
            if step.index not in self._todo:
                continue
            took_s = 1.0
            if step.source_um is not None and step.source_um not in moved:
                moved.add(step.source_um)
                took_s = 4.0
            elif step.scene_lit:
                took_s = 1.0 if scenes else 20.0
                scenes += 1
            SlowRunner.now_s += took_s
            done += 1
            assert self.on_progress is not None
            self.on_progress(RunStatus(RunState.RUNNING, done, len(self._plan), done))
        self._writer.close()
        return Run.open(self.path)

    now_s = 0.0


def test_a_first_plan_is_rehearsed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each kind of frame by its first and its later ones; the open bench does nothing."""
    plan = sweep_and_scene()
    monkeypatch.setattr(rehearsal, "Runner", SlowRunner)
    monkeypatch.setattr("instrument.runs.rehearsal.time.perf_counter", lambda: SlowRunner.now_s)
    seen: list[tuple[int, int]] = []
    with open_bench(parse_config(f'bench.data_folder = "{tmp_path}"\n' + TOML, None)) as bench:
        found = rehearse(plan, bench, lambda done, total: seen.append((done, total)))
        assert bench.stage is not None
        assert not bench.stage.is_homed
        abilities = abilities_of(bench)
    assert found is not None
    cost = estimate(plan, abilities)
    assert found.frame_s * cost.frames == pytest.approx(1 + 5 * 4 + 5 * 1 + 20 + 8 * 1)
    assert seen[-1] == (10, 10)  # of 20: one dark, three of each kind of PSF, three of the scene
    assert "a rehearsal of 10 of them" in found.words(plan, abilities)
    assert not list(tmp_path.iterdir())


def test_a_rehearsal_takes_frames() -> None:
    """It waits neither for the plan's own intervals, of an hour, nor for the stage."""
    with open_bench(parse_config(TOML, None)) as bench:
        found = rehearse(sweep_and_scene(), bench)
    assert found is not None
    assert "a rehearsal of 10 of them" in found.run


def test_parts_alike_are_rehearsed_once() -> None:
    """As a stage's check has them: a part a visit, to and fro between the same places."""
    plan = sweep_and_scene()
    again = plan.model_copy(update={"parts": plan.parts * 20})
    assert rehearsed(plan) == 10
    assert rehearsed(again) <= rehearsed(plan) + 6  # what comes back to a place that is known


def unplugged() -> BenchAbilities:
    raise DeviceError("stage", "does not answer")


def test_a_pace_is_kept_of_runs_that_lie_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(kept_times, "seen", lambda: True)
    with open_bench(parse_config(TOML, None)) as bench:
        abilities, toml = abilities_of(bench, tmp_path), bench.config.text
        run = acquire(bench, plan_of("a", 5), tmp_path / "there")
        keep_pace(run.path, lambda: abilities, toml)
        short = acquire(bench, plan_of("b", 2), tmp_path / "there")
        keep_pace(short.path, lambda: abilities, toml)  # tells nothing
    keep_pace(run.path, unplugged, toml)  # after the run, whose end it does not spoil
    found = pace_of(plan_of("a", 9), abilities, tmp_path / "here", toml)
    assert found is not None
    assert found.run == run.path.name
    assert found.frame_s > 0
    assert pace_of(plan_of("a", 9), abilities, tmp_path / "here", toml + "# changed\n") is None
    kept_times.place().write_text('{"a frame of": 3')
    assert pace_of(plan_of("a", 9), abilities, tmp_path / "here", toml) is None
