"""A plan's time with what frames took beside exposure and motion in a run before, on the same bench."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import DeviceError
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.files import kept_times
from instrument.plan import BenchAbilities, Part, Plan
from instrument.runs.acquire import abilities_of, acquire
from instrument.runs.pace import Pace, keep_pace, pace_of

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
