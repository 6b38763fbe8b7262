"""Each calibration routine under each fault of the simulated bench: what it says, and what became of it.

    python benchmarks/calibration_faults.py                          every routine, every fault
    python benchmarks/calibration_faults.py --only axial lateral     some routines
    python benchmarks/calibration_faults.py --fault flicker --sizes 0.25 0.5 1
    python benchmarks/calibration_faults.py --only photograph --fault flicker --draws 8

Each trial carries a routine out twice as a person would, on a bench without faults and on one with this fault
alone, everything else alike, and holds the results against one another. The change is relative; of PSFs it is
the largest of three: their shape once registered, their brightness relative to one another, and their places
relative to the first (a tenth of a pixel counts as 1 %); a common shift and a common brightness are none, nor
is a photograph's brightness. Of the angular and of the field's response it is the largest difference, of the
SLM's table in turns, of a mask's alignment the root mean square of the displacement over the mask, in mask
pixels of which a tenth counts as 1 %. Of beads it is the photographs that are solved: what is solved of them
is theirs alone; of a stage its play, of which 10 um are 2 %; of a display that is learned the part of the
contrast that it leaves unexplained of photographs of a bench without faults, patterns that it never saw.
``--draws`` repeats a trial with later frames of
the same bench, so that what flickers or shakes does so otherwise; the words of a cell are then those of each
draw, the change is the largest.

=========  ==============================================================================================
harmless   the result changed by 2 % at the most, and nothing was said
corrected  it changed by 2 % at the most, and the fault was said
named      it changed by more, the words name the fault, and the result does not call itself good
told       it changed by more, the words name the fault, but the result calls itself good
found      it changed by more, and something was said, but of something else
refused    there is no result, and the words name the fault (``refused*``: they name something else)
missed     it changed by more, and nothing was said
alarm      it changed by 2 % at the most, and something else was said
=========  ==============================================================================================
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.display_learning import configuration
from calibration_routines.display.display_io import DisplayBench, require_slm
from calibration_routines.display.hologram_photograph import HologramCamera
from calibration_routines.display.mask_alignment import AlignmentReport
from calibration_routines.display.pattern_series import photograph_series
from calibration_routines.optics.angular_response import AngularResponse
from calibration_routines.optics.bead_photographs import BeadSlides, photograph_slides
from calibration_routines.optics.dpc import DiffuserSurface
from calibration_routines.optics.field_response import measure_field_response
from calibration_routines.optics.photograph import Photograph
from calibration_routines.procedure import Listener
from calibration_routines.routine import routines
from calibration_routines.scatter import compare
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config, template
from instrument.display.bench_display import bench_display
from instrument.files.errors import BenchError
from instrument.runs.run_control import RunControl
from recon.camera.registration import moved
from recon.errors import InputError
from recon.holography.learn import Lesson, Look, unexplained

Array = npt.NDArray[np.floating]
TOLERATED = 0.02

TINY = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
{stage}
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
{source}
[scene]
control = "simulated"
[geometry]
{geometry}
[simulated]
preset = "tiny"
time_scale = 0
{world}
"""


@dataclass(frozen=True)
class Fault:
    """Something wrong: tables of the configuration given its size, and what a right word about it holds."""

    tables: Callable[[float], Mapping[str, str]]
    size: float
    words: str
    """Of this fault: what is said of others' alone is none."""
    display: bool = False
    """Whether benches without the point source's stage can have it."""


def _world(text: str) -> Callable[[float], Mapping[str, str]]:
    return lambda size: {"world": text.format(size)}


FAULTS = {
    "flicker": Fault(_world("flicker = {0}"), 0.2, "flicker", display=True),
    "drift": Fault(_world("drift_per_min = -{0}"), 0.3, "dimmer|taken out|drift", display=True),
    "vibration": Fault(_world("vibration_px = {0}"), 0.5, "shake", display=True),
    "creep": Fault(_world("creep_px_per_min = {0}"), 4.0, "moved|moves|creeps", display=True),
    "ambient": Fault(
        _world("ambient_e_per_s = {0}\nambient_period_s = 120"), 4e4, "other light", display=True
    ),
    "late hot": Fault(
        _world("late_hot_pixels = {0:.0f}\nlate_hot_e_per_s = 1e6\nlate_hot_after_s = 8"),
        300,
        "turned hot",
        display=True,
    ),
    "play": Fault(
        lambda s: {"stage": "\n".join(f"axes.{a}_um.backlash = {s}" for a in "xyz")}, 200, "play|backlash"
    ),
    "slip x": Fault(
        lambda s: {"stage": f"axes.x_um.slip = {s}\naxes.x_um.slip_at_move = 3"}, 500, r"slip|lost steps"
    ),
    "slip z": Fault(
        lambda s: {"stage": f"axes.z_um.slip = {s}\naxes.z_um.slip_at_move = 6"},
        2000,
        "slip|lost steps|source came",
    ),
    "mount": Fault(
        lambda s: {"stage": f"mount_offset_um = [{0.1 * s}, {-0.075 * s}, {s}]"},
        4000,
        "as if the source stood|mount held|the source's distance",
    ),
    "lean": Fault(lambda s: {"stage": f"mount_tilt_mrad = [{s}, 0]"}, 10, "rail leans"),
    "wrong d": Fault(
        lambda s: {"geometry": f"diffuser_distance_mm = {8.9 * (1 + s)}"}, 0.1, r"as if d were|check d\b"
    ),
    "wrong pitch": Fault(
        lambda s: {"geometry": f"pixel_pitch_um = {13 * (1 + s)}"}, 0.1, "pixel pitch|pixel_pitch_um"
    ),
    "pinhole": Fault(
        lambda s: {"world": f"source_diameter_um = {s}", "source": f"size_um = {s}"},
        1500,
        "source.*large|pinhole",
    ),
    "pinhole unsaid": Fault(
        lambda s: {"world": f"source_diameter_um = {s}"}, 400, "source of|source is too large|pinhole"
    ),
}


@dataclass(frozen=True)
class Trial:
    """A routine on its bench: the configuration's text, how it is carried out, what its result is."""

    text: str
    carry_out: Callable[[Bench, Path], tuple[Array, list[str], bool]]
    change: Callable[[Array, Array], float]
    display: bool = False


def _relative(found: Array, usual: Array) -> float:
    return float(np.linalg.norm(found - usual) / np.linalg.norm(usual))


def _but_for_brightness(found: Array, usual: Array) -> float:
    return _relative(found * (np.vdot(found, usual) / np.vdot(found, found)), usual)


def _of_slides(found: Array, usual: Array) -> float:
    """Return the largest change of a photograph: a slide's brightness and place are its own."""
    pairs = list(zip(found, usual, strict=True))
    changes = [compare(one.astype(np.float32), other.astype(np.float32)) for one, other in pairs]
    there = [moved(one, -c.rows, -c.columns) for (one, _), c in zip(pairs, changes, strict=True)]
    return max(_but_for_brightness(one, other) for one, (_, other) in zip(there, pairs, strict=True))


def _of_psfs(found: Array, usual: Array) -> float:
    """Return the largest change of shape, relative brightness and relative place (0.1 pixels: 1 %)."""
    first, second = (psfs.mean(axis=1).astype(np.float32) for psfs in (found, usual))
    changes = [compare(one, other) for one, other in zip(first, second, strict=True)]
    if not all(np.isfinite((c.rows, c.columns, c.brightness)).all() for c in changes):
        return float("inf")
    levels = np.array([change.brightness for change in changes])
    places = np.array([(change.rows, change.columns) for change in changes])
    back = [moved(one, -c.rows, -c.columns) / c.brightness for one, c in zip(first, changes, strict=True)]
    shapes = [_relative(one, other) for one, other in zip(back, second, strict=True)]
    apart = float(np.hypot(*(places - places[0]).T).max())
    return max(float(np.median(shapes)), float(levels.std() / levels.mean()), 0.1 * apart)


def _largest(found: Array, usual: Array) -> float:
    return float(np.abs(found - usual).max())


def _routine(name: str, result: Callable[[Any], Array], **asked: Any) -> Callable[..., Any]:
    def carry_out(bench: Bench, folder: Path) -> tuple[Array, list[str], bool]:
        out = {"out": folder / f"{name}.json"} if name in ("slm", "mask", "display") else {}
        done = routines[name].asked(asked | out).carry_out(bench, folder)
        return result(done), list(done.verdict), done.good

    return carry_out


def _psfs(done: Any) -> Array:
    return np.asarray(done.result.calibration.psfs)


def _response(done: Any) -> Array:
    response = done.result
    assert isinstance(response, AngularResponse)
    return np.concatenate([response.along_x.response, response.along_y.response])


def _height(done: Any) -> Array:
    assert isinstance(done.result, DiffuserSurface)
    return done.result.height_um


def _picture(done: Any) -> Array:
    assert isinstance(done.result, Photograph)
    return done.result.measurement


def _table(done: Any) -> Array:
    return np.asarray(done.result.correction.phase_of_level_rad) / (2 * np.pi)


def _displacement(done: Any) -> Array:
    assert isinstance(done.result, AlignmentReport)
    return done.result.displacement(done.result.mask_shape)


@cache
def _true_looks() -> tuple[Look, ...]:
    """Return photographs of patterns that nobody learns from, on the bench without faults."""
    with open_bench(parse_config(_LEARNED, None)) as bench:
        slm, config = require_slm(bench), bench.config
        known = bench_display(config, (slm.shape, slm.pixel_pitch_um))
        seen = HologramCamera.registered(DisplayBench(bench, config.display.slm_binning), known)
        return photograph_series(seen, 3, seed=7).looks


def _left(done: Any) -> Array:
    assert isinstance(done.result, Lesson)
    return np.array([unexplained(done.result.display, _true_looks()) ** 2])


def _play(done: Any) -> Array:
    return np.array([axis.play_um for axis in done.result.axes])


def _of_play(found: Array, usual: Array) -> float:
    """Return the largest change of a stage's play; 10 um are 2 %."""
    return float(np.abs(found - usual).max()) / 500


def _tenths(found: Array, usual: Array) -> float:
    return 0.1 * float(np.sqrt(np.mean(np.square(found - usual).sum(axis=-1))))


def _beads(bench: Bench, folder: Path) -> tuple[Array, list[str], bool]:
    taken = photograph_slides(bench, BeadSlides(images=3), folder, RunControl(), Listener())
    return taken.images, list(taken.findings), not taken.findings


def _field(bench: Bench, folder: Path) -> tuple[Array, list[str], bool]:
    assert bench.stage is not None
    bench.stage.home()
    bench.place_source(0.0, 0.0, 100e3)
    response = measure_field_response(bench, (6e3, 8e3), 100e3, 4.0, folder, average=4)
    at = np.linspace(0, 0.08, 9)
    words = [f"misfit {response.misfit:.3f}"]
    return np.concatenate([response(0 * at, at), response(at, 0 * at)]), words, True


_SCREEN = (
    template("screen")
    .replace("color = false", "color = false\nbinning = 2\nexposure_ms = 20.0")
    .replace("[1080, 1920]", "[140, 180]")
    .replace("270.0", "700.0")
    .replace('preset = "tiny"', 'preset = "tiny"\naperture_mm = [0.8, 1.0]')
)
_LED, _DISPLAY = template("led_microscope").replace("pixels = 384", "pixels = 160"), template("display")
for _key, _value in {
    "shape": "[200, 280]",
    "relay_distortion_um": "0.0",
    "shift_um": "[31.0, -42.0]",
}.items():
    _DISPLAY = re.sub(rf"(?m)^{_key} = [^#\n]*", f"{_key} = {_value} ", _DISPLAY)
_LEARNED = configuration("errors", expansion=4, seed=0).replace("[slm]\n", "[slm]\nsettle_ms = 1000.0\n")
_SPOTS = {"reach": 8.0, "depth_um": 100.0, "spots": 25, "refinements": 2, "section_pictures": 2}
_SLIDE = 'scene = "beads"\nbeads = {}\n'
_MICROSCOPE = TINY.replace('driver = "simulated"', 'driver = "simulated"\nbinning = 4', 1).replace(
    'preset = "tiny"', 'preset = "microscope"'
)
_NEAR = {"z_min_um": 60e3, "z_max_um": 150e3}
TRIALS = {
    "axial": Trial(TINY, _routine("axial", _psfs, **_NEAR, planes=7, reference_every=3), _of_psfs),
    "lateral": Trial(
        TINY,
        _routine(
            "lateral",
            _psfs,
            z_um=80e3,
            spacing_um=6e3,
            half_field_x_um=6e3,
            half_field_y_um=6e3,
            reference_every=3,
        ),
        _of_psfs,
    ),
    "volume": Trial(
        TINY,
        _routine(
            "volume", _psfs, **_NEAR, planes=4, spacing_um=8e3, half_field_x_um=4e3, half_field_y_um=4e3
        ),
        _of_psfs,
    ),
    "angular": Trial(
        TINY, _routine("angular", _response, largest_deg=9.0, step_deg=3.0, z_um=80e3), _largest
    ),
    "field": Trial(TINY, _field, _largest),
    "beads": Trial(TINY + _SLIDE.format(20) + "scene_distance_mm = 80.0\n", _beads, _of_slides),
    "microscope": Trial(_MICROSCOPE + _SLIDE.format(6), _beads, _of_slides),
    "photograph": Trial(TINY, _routine("photograph", _picture), _but_for_brightness),
    "stage": Trial(TINY, _routine("stage", _play), _of_play),
    "screen": Trial(
        _SCREEN,
        _routine("screen", _psfs, pictures=6, judged=2, average=2, dark_frames=2),
        _of_psfs,
        display=True,
    ),
    "dpc": Trial(
        _LED, _routine("dpc", _height, objective_na=0.1, magnification=4.0), _relative, display=True
    ),
    "slm": Trial(_DISPLAY, _routine("slm", _table), _largest, display=True),
    "mask": Trial(_DISPLAY, _routine("mask", _displacement, **_SPOTS), _tenths, display=True),
    "display": Trial(_LEARNED, _routine("display", _left, patterns=8), _largest, display=True),
}


def _text(trial: Trial, fault: Fault | None, size: float) -> str:
    tables = dict.fromkeys(("stage", "source", "geometry", "world"), "")
    tables |= {} if fault is None else fault.tables(size)
    return (
        trial.text.format(**tables)
        if not trial.display
        else trial.text.rstrip() + "\n" + tables["world"] + "\n"
    )


def carried_out(
    trial: Trial, fault: Fault | None, size: float = 0.0, draw: int = 0
) -> tuple[Array | None, list[str], bool]:
    """Return a trial's result, what was said, and whether it calls itself good; None where it was refused."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            with open_bench(parse_config(_text(trial, fault, size), None)) as bench:
                for _ in range(draw):  # the same frame is disturbed alike
                    bench.camera.snap()
                return trial.carry_out(bench, Path(folder))
        except (BenchError, InputError) as error:
            return None, [str(error)], False


def judged(fault: Fault, usual: Array, trial: Trial, size: float, draw: int = 0) -> tuple[str, float, str]:
    """Return what became of a fault, how much the result changed, and the sentence."""
    result, words, good = carried_out(trial, fault, size, draw)
    telling = [line for line in words if re.search(fault.words, line)]
    said = (telling or words or [""])[0]
    if result is None:
        return "refused" if telling else "refused*", float("nan"), said
    change = trial.change(result, usual) if result.shape == usual.shape else float("nan")
    doubted = not good
    if change <= TOLERATED:
        return ("alarm" if doubted and not telling else "corrected" if telling else "harmless"), change, said
    if telling and not doubted:
        return "told", change, said
    return ("named" if doubted and telling else "found" if doubted else "missed"), change, said


def main() -> None:
    """Print a line for each routine and fault, and the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(TRIALS), default=list(TRIALS))
    parser.add_argument("--fault", nargs="+", choices=list(FAULTS), default=list(FAULTS))
    parser.add_argument("--sizes", nargs="+", type=float, default=[1.0], help="Factors on the faults' sizes.")
    parser.add_argument("--draws", type=int, default=1, help="Times that each is tried.")
    parser.add_argument("--words", action="store_true", help="Print what was said, too.")
    arguments = parser.parse_args()
    rows: dict[str, list[str]] = {}
    for name in arguments.only:
        trial = TRIALS[name]
        usual, words, good = carried_out(trial, None)
        assert usual is not None, words
        print(f"{name}: without faults {'good' if good else 'DOUBTED'}: {' '.join(words)[:300]}", flush=True)
        for title in arguments.fault:
            fault = FAULTS[title]
            for factor in arguments.sizes:
                row = rows.setdefault(f"{title} {fault.size * factor:g}", [])
                if trial.display and not fault.display:
                    row.append("")
                    continue
                began = time.process_time()
                tried = [
                    judged(fault, usual, trial, fault.size * factor, draw) for draw in range(arguments.draws)
                ]
                found = Counter(became for became, _, _ in tried)
                several = [f"{many} {became}" for became, many in found.items()]
                cell = tried[0][0] if len(tried) == 1 else ", ".join(several)
                changes = [change for _, change, _ in tried if not np.isnan(change)]
                row.append(f"{cell} {max(changes):.1%}" if changes else cell)
                print(
                    f"  {title} {fault.size * factor:g}: {row[-1]}, {time.process_time() - began:.1f} s",
                    flush=True,
                )
                if arguments.words:
                    for _, _, said in tried:
                        print(f"    {said[:400]}", flush=True)
    print("\n| fault | " + " | ".join(arguments.only) + " |\n|---" * 1 + "|---" * len(arguments.only) + "|")
    for title, cells in rows.items():
        print(f"| {title} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
