"""A sweep of one's own: one class of options and a row of the registry, and it is in terminal and window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from pathlib import Path

import pytest

from calibration_routines import PointSweep
from calibration_routines.options import MM
from calibration_routines.psf.sweep_options import PlannedSweep, Taking
from calibration_routines.psf.sweep_procedure import SweepProcedure
from calibration_routines.routine import Routine, routines
from instrument.bench.bench import Bench
from instrument.cli import main
from instrument.files.calibration_file import load_calibration
from recon.base.declare import option, options_of
from recon.errors import InputError

TINY = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
"""


@dataclass(frozen=True, kw_only=True)
class CrossSweep(Taking):
    """PSFs on the axis and at the ends of a cross."""

    z_um: float = option(MISSING, **MM, above=0, flags=("--z",), label="Depth", help="Depth of the cross.")
    arm_um: float = option(
        5e3, **MM, above=0, flags=("--arm",), label="Arm", help="From its middle to an end."
    )

    def planned(self, bench: Bench) -> PlannedSweep:
        ends = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
        points = tuple((x * self.arm_um, y * self.arm_um, self.z_um) for x, y in ends)
        sweep = PointSweep(points_um=points, kind="cross", average=self.average, dark_frames=self.dark_frames)
        return PlannedSweep(sweep, ("Five places, as a cross",))


CROSS = Routine(
    name="cross",
    title="Cross",
    help="Measure PSFs on the axis and at the ends of a cross.",
    options=CrossSweep,
    procedure=SweepProcedure,
    needs=("stage",),
    start=lambda _: {"z_um": 1e5},
)


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    routines.register(CROSS)
    yield
    routines._foreign.pop("cross")


def test_the_terminal_has_it_with_its_options_and_their_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bench.toml").write_text(TINY)
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", "--help"]) == 0
    assert "Measure PSFs on the axis and at the ends of a cross." in capsys.readouterr().out
    assert main(["calibrate", "cross", "--help"]) == 0
    said = capsys.readouterr().out
    assert "--arm MM" in said
    assert "From its middle to an end.  [default: 5]" in said
    assert main(["calibrate", "cross", "--z", "100", "--arm", "-1"]) == 2
    assert "--arm must be a number, above 0 (mm), not -1" in capsys.readouterr().err
    assert main(["calibrate", "cross", "--z", "100", "--arm", "2", "--average", "1"]) == 0
    said = capsys.readouterr().out
    assert "Five places, as a cross" in said
    (path,) = tmp_path.glob("runs/*/calibration")
    assert str(path) in said
    assert load_calibration(path).source_positions_um.tolist()[1] == [2e3, 0.0, 1e5]


def test_the_window_has_its_form() -> None:
    routine = list(routines.values())[-1]
    assert (routine.name, routine.title, routine.needs) == ("cross", "Cross", ("stage",))
    labels = {o.name: o.label for o in options_of(routine.options)}
    assert labels["arm_um"] == "Arm (mm)"
    assert labels["average"] == "Frames a PSF"
    made = routine.procedure(routine.options(z_um=1e5, arm_um=1e3))
    assert made == SweepProcedure(CrossSweep(z_um=1e5, arm_um=1e3))


def test_a_name_that_is_taken_is_refused() -> None:
    with pytest.raises(InputError, match="axial"):
        routines.register(
            Routine(name="axial", title="", help="", options=CrossSweep, procedure=SweepProcedure)
        )
