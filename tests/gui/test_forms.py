"""Forms: what they make, what they refuse and where, and that their Python really runs."""

from __future__ import annotations

from dataclasses import MISSING
from pathlib import Path
from typing import Any

import pytest

from calibration_routines.display.mask_alignment import AlignmentProcedure
from calibration_routines.optics.beads import BeadProcedure
from calibration_routines.options import Size
from calibration_routines.plan_procedures import PlanProcedure
from calibration_routines.procedure import Outcome, Outlook, Procedure
from calibration_routines.psf.sweep_options import AxialSweep
from calibration_routines.psf.sweep_procedure import SweepProcedure
from calibration_routines.routine import Routine, routines
from gui.panels.sweeps import ILLUMINATION, PLAN
from gui.procedure_run import script
from instrument.bench.bench import Bench
from instrument.bench.config_file import template
from instrument.files.errors import BenchError, SettingsError
from recon.base.declare import options_of

AXIAL, LATERAL, VOLUME, STAGE, PHOTOGRAPH, ANGULAR, DPC, BEADS, SCREEN, SLM, ALIGNMENT, DISPLAY = (
    routines.values()
)
STARTS = {"z_min_um": 60e3, "z_max_um": 150e3, "z_um": 100e3, "objective_na": 0.1, "magnification": 4.0}


def make(routine: Routine, **changed: Any) -> Procedure:
    """What a form makes of its defaults, of values that follow from a bench, and of changes."""
    defaults = {o.name: None if o.default is MISSING else o.default for o in options_of(routine.options)}
    values = {n: STARTS.get(n, value) if value is None else value for n, value in defaults.items()}
    return routine.procedure(routine.options(**(values | changed)))


@pytest.mark.parametrize("form", [*routines.values(), PLAN], ids=lambda form: form.name)
def test_a_form_names_its_settings_as_the_code_does(form: Any) -> None:
    procedure = make(form)
    assert procedure == make(form)
    for field in options_of(form.options):
        assert field.label
        assert field.declaration.help
        assert field.default not in (None, MISSING) or field.declaration.default_words or field.name in STARTS
    compile(script(procedure, None), form.name, "exec")


def test_settings_reach_the_request_in_its_units() -> None:
    procedure = make(AXIAL, planes=3, average=2)
    assert procedure == SweepProcedure(AxialSweep(z_min_um=60e3, z_max_um=150e3, planes=3, average=2))


@pytest.mark.parametrize(
    ("form", "changed", "field"),
    [
        (LATERAL, {"target": 3.0}, "target"),
        (LATERAL, {"half_field_y_um": 1e3}, "half_field_x_um"),
        (BEADS, {"images": 1}, "images"),
        (BEADS, {"rank": 0}, "rank"),
        (SCREEN, {"pictures": 1}, "pictures"),
        (PLAN, {"text": "label = "}, "text"),
        (ILLUMINATION, {"exposure_ms": 5.0}, "groups"),
    ],
)
def test_a_mistake_names_its_field(form: Any, changed: dict[str, Any], field: str) -> None:
    with pytest.raises(SettingsError) as refused:
        make(form, **changed)
    assert [name for name, _ in refused.value.problems] == [field]


def test_the_example_plan_is_a_plan_and_a_wrong_one_is_refused_in_words() -> None:
    procedure = make(PLAN)
    assert isinstance(procedure, PlanProcedure)
    assert len(procedure.plan) > 0
    with pytest.raises(BenchError, match="parts"):
        make(PLAN, text='label = "empty"')


BENCH = """
[bench]
data_folder = "runs"
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
time_scale = 0
"""
POINT = """
label = "two places"
[[parts]]
label = "psf"
light = "source"
positions = { kind = "points", points_um = [[0, 0, 8e4], [0, 0, 9e4]] }
"""


def bench_for(form: Any) -> str:
    """A small bench that has what a routine needs."""
    if form is DPC:
        return template("led_microscope").replace("pixels = 384", "pixels = 96")
    if form is SLM:
        return template("display").replace("[360, 640]", "[100, 140]")
    return BENCH


FAST = {"average": 1, "dark_frames": 1}


@pytest.mark.parametrize(
    ("form", "changed"),
    [
        (VOLUME, {"planes": 2, "half_field_x_um": 0.0, "half_field_y_um": 0.0, "spacing_um": 1e3, **FAST}),
        (ANGULAR, {"largest_deg": 10.0, "step_deg": 5.0, **FAST}),
        (DPC, FAST),
        (AXIAL, {"planes": 2, **FAST}),
        (LATERAL, {"half_field_x_um": 0.0, "half_field_y_um": 0.0, "spacing_um": 1e3, **FAST}),
        (PHOTOGRAPH, FAST),
        (PLAN, {"text": POINT}),
        (ILLUMINATION, {"exposure_ms": 5.0, "pattern": "half na=0.3"}),
        (SLM, {"levels": 8}),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_the_python_of_a_form_runs(
    form: Any, changed: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_for(form))
    lines = script(make(form, **changed), bench)
    names: dict[str, Any] = {}
    exec(lines, names)
    done = names["done"]
    written = [*done.runs, *done.files]
    assert all(path.exists() for path in written)
    assert written[0].parent == tmp_path / "runs"
    assert done.verdict[0] in capsys.readouterr().out


@pytest.mark.parametrize(
    ("form", "kind", "changed"),
    [
        (ALIGNMENT, AlignmentProcedure, {"reach": 6.0, "division": Size(2, 3), "moves": 0}),
        (BEADS, BeadProcedure, {"images": 2, "grid": Size(1, 2), "rank": 1}),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_the_python_of_what_takes_minutes_asks_for_what_the_form_says(
    form: Any, kind: Any, changed: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(template("display").replace("[360, 640]", "[100, 140]") if form is ALIGNMENT else BENCH)
    asked: list[Any] = []

    def carry_out(procedure: Any, opened: Bench) -> Outcome:
        asked.append(procedure)
        assert all(device.is_open for device in opened.devices.values())
        return Outcome(verdict=("done",), good=True)

    monkeypatch.setattr(kind, "outlook", lambda *_: Outlook(("looked",)))
    monkeypatch.setattr(kind, "carry_out", carry_out)
    procedure = make(form, **changed)
    exec(script(procedure, bench), {})
    assert asked == [procedure]
