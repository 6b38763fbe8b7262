"""A fault at every call of every device, and what became of light, motion, run, exit code and words.

    python benchmarks/fault_table.py                       every call, every fault, all work: hours
    python benchmarks/fault_table.py --every 7 run snap    a sample
    python benchmarks/fault_table.py align --first 60 --every 9    at once, without the whole work before

Each trial is a process of its own that carries out a command of the terminal on the simulated bench, or a
live session of eight pictures from Python. The device call with the trial's number (counted at the driver,
whoever makes it; reading a property is a call)

=========  =======================================================================================
exception  raises an error that is no DeviceError, as a faulty driver's does
hang       does not return
nan        returns what it did, with every number in it NaN
garbage    returns what it did, with every number a large one and every picture a fraction of itself
unplugged  raises DeviceLostError, as does every later call of that device
=========  =======================================================================================

Of each is printed whether the light was off and motion stopped in the end (``said``: the device could no
longer be told, and the program says so), what the run calls itself and whether ``verify`` finds it sound, the
exit code, and the sentence. Where a call that hangs is not given up, the trial gets Ctrl-C after some
seconds (``held up``; of ``--first``, which does not know how long the work takes, after ten minutes). Of a
trial that ended before its call nothing is known (``not reached``). A fault that changes nothing that is
used is ``harmless``: exit code 0, light off, the run complete. Exit status 1 when anything else was
found than that.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import math
import os
import pickle
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.crash_work import BENCH, PLAN, runs_in
from drivers.camera import Camera
from drivers.device import Device
from drivers.errors import DeviceError, DeviceLostError
from drivers.led_array import LedArray
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.display import DisplayStage
from drivers.simulated.led_array import SimulatedLedArray
from drivers.simulated.slm import SimulatedSlm
from drivers.simulated.stage import SimulatedStage
from drivers.slm import Slm
from drivers.stage import Stage
from instrument.bench.bench import open_bench
from instrument.bench.config_file import load_config, template
from instrument.cli import main
from instrument.files.errors import BenchError
from instrument.live.live import live_view
from instrument.runs.inspection import verify
from instrument.runs.run import Run, RunCondition
from recon.types import Calibration

DRIVERS = {
    SimulatedCamera: Camera,
    SimulatedStage: Stage,
    DisplayStage: Stage,
    SimulatedLedArray: LedArray,
    SimulatedSlm: Slm,
}
"""Each with the interface whose methods are called."""
AT_ONCE = ("pattern", "displayed", "computed_s")
"""They do not hang: a driver tells them without asking its device (docs/reference/safety.md)."""
FAULTS = ("exception", "hang", "nan", "garbage", "unplugged")
_ALIGN = ["align", "mask", "--reach", "8", "--depth-um", "100", "--spots", "25", "--moves", "1"]
WORK = {
    "run": ["run", "plan.json", "--out", "runs"],
    "record": ["record", "--source", "--frames", "6", "--out", "runs"],
    "snap": ["snap", "--source", "--out", "a.tif", "--force"],
    "sweep": ["calibrate", "axial", "--z-min", "20", "--average", "1", "--dark-frames", "1", "--out", "runs"],
    "align": [*_ALIGN, "--sections", "2x2", "--section-pictures", "2", "--bench", "display.toml", "--force"],
    "live": ["live"],
}
DISPLAY = {
    "shape = [360, 640]": "shape = [200, 280]",
    "shift_um = [120.0, -70.0]": "shift_um = [31.0, -42.0]",
    "z_um = 300.0": "z_um = 60.0",
    "relay_distortion_um = 3.0": "relay_distortion_um = 0.0",
}
"""What makes the display's bench small."""
SOON_S = 2.0
"""What the waits for a device that hangs are shortened to."""
PATIENCE_S = 600.0
"""How long the work without a fault may take."""
HELD_UP_S, END_S = 7.0, 25.0
"""When a trial gets Ctrl-C, and when it is killed, beside three times what the work takes without a fault."""


@dataclass(frozen=True)
class Outcome:
    """What a trial came to."""

    call: str
    light: str
    motion: str
    run: str
    code: int | None
    said: str
    held_up: bool

    @property
    def judged(self) -> str:
        """``ok``, ``harmless``, ``held up``, ``not reached``, or what is wrong."""
        wrong = [
            what
            for what, found in (
                ("light on", self.light == "ON"),
                ("moving", self.motion == "MOVING"),
                ("killed", self.code is None),
                ("traceback", "Traceback" in self.said),
                ("no words", self.code != 0 and not self.said.strip()),
                ("run " + self.run, "unsound" in self.run or self.run in ("running", "crashed")),
                ("complete, yet an error", self.code not in (0, None) and self.run == "completed, not last"),
            )
            if found
        ]
        if wrong:
            return ", ".join(wrong).upper()
        if self.code == 0:
            return "harmless" if self.call else "not reached"
        return "held up" if self.held_up else "ok"


class Faulty:
    """Counts the outermost calls of drivers' methods, and has one of them go wrong."""

    def __init__(self, number: int, fault: str) -> None:
        self.number, self.fault = number, fault
        self.calls: list[str] = []
        self.devices: dict[str, Device] = {}
        self._lost: set[str] = set()
        self._inside = threading.local()

    def install(self) -> None:
        """Wrap the public methods and properties of the simulated drivers, before a bench is made of them.

        Those that a driver answers by itself stay as they are.
        """
        for driver, interface in DRIVERS.items():
            for name in (name for name in dir(interface) if not name.startswith("_")):
                member = getattr(driver, name)
                if name in ("check", "claims", "name", "is_open"):
                    continue
                if isinstance(member, FunctionType):
                    setattr(driver, name, self._wrapped(name, member))
                elif isinstance(member, property) and member.fget is not None:
                    setattr(driver, name, property(self._wrapped(name, member.fget)))

    def _wrapped(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def call(device: Device, *args: Any, **named: Any) -> Any:
            if getattr(self._inside, "deep", False):
                return method(device, *args, **named)
            self._inside.deep = True
            try:
                return self._outermost(name, method, device, args, named)
            finally:
                self._inside.deep = False

        return call

    def _outermost(self, name: str, method: Callable[..., Any], device: Any, args: Any, named: Any) -> Any:
        self.devices[device.kind] = device
        here = len(self.calls)
        self.calls.append(f"{device.kind}.{name}")
        if device.kind in self._lost or (here == self.number and self.fault == "unplugged"):
            self._lost.add(device.kind)
            device._is_open = False
            raise DeviceLostError(device.name, "was unplugged.", "Plug it in.")
        if here != self.number:
            return method(device, *args, **named)
        if self.fault == "exception":
            raise ZeroDivisionError("a mistake of the driver's")
        if self.fault == "hang" and name not in AT_ONCE:
            threading.Event().wait()
        return changed(method(device, *args, **named), math.nan if self.fault == "nan" else 9.9e9)

    def lit(self) -> bool:
        """Whether the LED array or the scene shines, whatever they say."""
        array, camera = self.devices.get("led_array"), self.devices.get("camera")
        shines = array is not None and not array._pattern.is_dark  # type: ignore[attr-defined]
        return shines or (camera is not None and camera.world.scene_lit)  # type: ignore[attr-defined]

    def moving(self) -> bool:
        """Whether the stage moves, whatever it says."""
        stage = self.devices.get("stage")
        return stage is not None and stage.carriage.is_moving  # type: ignore[attr-defined]


def changed(value: Any, number: float) -> Any:
    """Return a driver's answer with ``number`` for its numbers; what has none stays."""
    if isinstance(value, float):
        return number
    if isinstance(value, dict):
        return {key: changed(item, number) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value[:1] if math.isfinite(number) else value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            f.name: changed(getattr(value, f.name), number) for f in dataclasses.fields(value) if f.init
        }
        with contextlib.suppress(Exception):
            return type(value)(**fields)
    return value


def soon() -> None:
    """Shorten the waits for a device that hangs."""
    from drivers.common import checked, stream
    from instrument.bench import bench, safety

    for module in (stream, bench, safety):
        setattr(module, "STOP_ANSWER_S", SOON_S)  # noqa: B010 # its type is final
    setattr(stream, "CALL_MARGIN_S", SOON_S)  # noqa: B010
    checked.call_limit_s = lambda *_: SOON_S
    Device.longest_call_s = SOON_S
    SimulatedCamera.longest_silence_s = SOON_S


def prepare(folder: Path) -> None:
    """Make a folder with nothing but a bench and a plan in it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "bench.toml").write_text(BENCH + '[slm]\ndriver = "simulated"\n')
    (folder / "plan.json").write_text(PLAN.to_json())
    display = template("display")
    for large, small in DISPLAY.items():
        display = display.replace(large, small)
    (folder / "display.toml").write_text(display)


def live() -> int:
    """Show eight live pictures of the lit scene; the exit code and words are as the terminal's."""
    psf = np.random.default_rng(1).random((1, 1, 64, 96)).astype(np.float32) ** 8
    calibration = Calibration(psf, np.array([[0.0, 0.0, 1e5]]))
    try:
        with open_bench(load_config(Path("bench.toml"))) as bench:
            bench.scene_on()
            with live_view(bench, calibration, budget_ms=20.0) as view:
                for _ in zip(range(8), view, strict=False):
                    pass
    except (DeviceError, BenchError) as error:
        sys.stderr.write("\n".join((str(error), *getattr(error, "__notes__", ()))) + "\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("interrupted.\n")
        return 130
    return 0


def trial(work: str, number: int, fault: str, folder: Path, longer_s: float) -> tuple[Outcome, list[str]]:
    """Carry out one command in a process of its own, with one fault."""
    prepare(folder)
    process = os.fork()
    if process == 0:
        code, faulty = 70, Faulty(number, fault)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
        try:
            os.chdir(folder)
            for handle, name in ((1, "out"), (2, "err")):
                os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), handle)
            faulty.install()
            if fault == "hang":
                soon()
            code = live() if work == "live" else main(WORK[work])
        except BaseException:  # noqa: BLE001 - shown, and the process ends here whatever it was
            traceback.print_exc()
        finally:
            with contextlib.suppress(BaseException):
                (folder / "state").write_bytes(pickle.dumps((faulty.calls, faulty.lit(), faulty.moving())))
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    try:
        status, held_up = _wait(process, longer_s)
    except BaseException:  # the table is ended: nothing goes on in a folder that is removed
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        raise
    said = (folder / "err").read_text() if (folder / "err").is_file() else ""
    calls, lit, moving = [], True, True
    if (folder / "state").is_file():
        calls, lit, moving = pickle.loads((folder / "state").read_bytes())
    outcome = Outcome(
        call=calls[number] if 0 <= number < len(calls) else "",
        light=("said" if "may be on" in said else "ON") if lit else "off",
        motion=("said" if "may be moving" in said else "MOVING") if moving else "stopped",
        run=_run_in(folder),
        code=None if os.WIFSIGNALED(status) else os.WEXITSTATUS(status),
        said=said,
        held_up=held_up,
    )
    return outcome, calls


def _wait(process: int, longer_s: float) -> tuple[int, bool]:
    """Wait for a trial; after some time Ctrl-C, and SIGKILL."""
    began_s, held_up = time.monotonic(), False
    while True:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return status, held_up
        passed_s = time.monotonic() - began_s - longer_s
        if passed_s > HELD_UP_S and not held_up:
            held_up = True
            os.kill(process, signal.SIGINT)
        if passed_s > END_S:
            os.kill(process, signal.SIGKILL)
        time.sleep(0.02)


def _run_in(folder: Path) -> str:
    """Return what the run says of itself, and whether it is sound."""
    runs = runs_in(folder / "runs") if (folder / "runs").is_dir() else []
    if not runs:
        return "none"
    run = Run.open(runs[0])
    if not verify(run).is_sound:
        return f"{run.condition}, unsound"
    whole = run.condition is RunCondition.COMPLETED and run.plan is not None and bool(run.missing())
    return f"{run.condition}, unsound" if whole else str(run.condition)


def table(work: str, faults: list[str], every: int, seed: int, among: int, folder: Path) -> Counter[str]:
    """Print a row for each fault at each chosen call; return how often each judgement was made.

    ``among`` the first so many calls only, without the whole work before (0: among all).
    """
    calls, longer_s = [""] * among, PATIENCE_S
    if not among:
        began_s = time.monotonic()
        whole, calls = trial(work, -1, "none", folder, PATIENCE_S)
        longer_s = 3 * (time.monotonic() - began_s)
        if whole.code != 0 or whole.light != "off":
            raise SystemExit(f"{work} itself failed ({whole.code}):\n{whole.said}")
    first = random.Random(seed).randrange(every)
    counts: Counter[str] = Counter()
    for number in range(first, len(calls), every):
        for fault in faults:
            found, _ = trial(work, number, fault, folder, longer_s)
            counts[found.judged] += 1
            words = [line for line in found.said.splitlines() if "SIMULATED" not in line and line.strip()]
            sentence = next((line.strip() for line in words if "(simulated):" in line), "".join(words[:1]))
            call = found.call or calls[number]  # what comes when is up to threads
            print(
                f"{work:<7}{number:>4} {call:<28}{fault:<10}{found.judged:<12}light {found.light:<5}"
                f"motion {found.motion:<8}run {found.run:<11}exit {found.code!s:<5}{sentence}",
                flush=True,
            )
    print(f"{work}: {len(calls)} calls; " + ", ".join(f"{n} {what}" for what, n in sorted(counts.items())))
    return counts


def run(arguments: list[str] | None = None) -> int:
    """Print the tables; return 1 when anything was unsafe, dishonest or without words."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("work", nargs="*", choices=[*WORK, []], help="commands [default: all]")
    parser.add_argument("--every", type=int, default=1, help="of so many calls one")
    parser.add_argument("--seed", type=int, default=0, help="which of them")
    parser.add_argument("--first", type=int, default=0, help="among the first so many calls [default: all]")
    parser.add_argument("--fault", action="append", choices=FAULTS, help="faults [default: all]")
    asked = parser.parse_args(arguments)
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as within:
        folder = Path(within, "trial")
        prepare(folder)
        quiet = contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO())
        with contextlib.chdir(folder), quiet[0], quiet[1]:
            main(WORK["snap"])  # what is imported and compiled here, no trial waits for
        for work in asked.work or WORK:
            counts += table(work, asked.fault or list(FAULTS), asked.every, asked.seed, asked.first, folder)
    return 1 if set(counts) - {"ok", "harmless", "held up", "not reached"} else 0


if __name__ == "__main__":
    raise SystemExit(run())
