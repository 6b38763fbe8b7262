"""What ``calibrate ... --dry-run`` tells of the time, held against what the routine then takes.

    python benchmarks/dry_runs.py [--only axial angular beads stage screen] [--compiled]
    python benchmarks/dry_runs.py --processor 4

Each on the preset ``tiny`` in real time, told and then taken in two processes, in a folder of its own without
what other runs took, and without kernels that others compiled (``--compiled``: with those that are there).
The time that the program takes to start is in neither: taken is what goes by from its first words on. The
screen, the LED microscope and the SLM are those of ``diffuserbench new``, the display that is learned that of
``benchmarks/display_learning.py``. ``--processor`` is for a busy machine: it tells and takes the screen by
default in processor seconds of one thread, the rehearsal ended after so many.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.display_learning import configuration
from calibration_routines import rehearsal
from calibration_routines.routine import routines
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config, template
from recon.base.threads import set_threads

ROOT = Path(__file__).resolve().parents[1]
BENCH = """
camera.driver = "simulated"
stage.driver = "simulated"
led_array.driver = "simulated"
source.rgb = [0, 255, 0]
scene.control = "simulated"
[simulated]
preset = "tiny"
"""
BEADS = 'scene = "beads"\nbeads = 20\n'
ROUTINES = {
    "photograph": ("",),
    "axial": ("--z-min 60 --z-max 150 --planes 6",),
    "lateral": ("--z 80",),
    "volume": ("--z-min 60 --z-max 150 --planes 3 --spacing 8 --half-field-x 8 --half-field-y 8",),
    "angular": ("",),
    "stage": ("",),
    "beads": ("--binning 4",),
    "screen": ("", "--binning 2 --pictures 8", "--pictures 30 --judged 5"),
    "dpc": ("--na 0.1 --magnification 4",),
    "slm": ("",),
    "display": ("--patterns 5",),
}
BENCHES = {
    "beads": BENCH + BEADS,
    "screen": template("screen"),
    "dpc": template("led_microscope"),
    "slm": template("display"),
    "display": configuration("errors", expansion=4, seed=0),
}
"""Of all others: :data:`BENCH`."""
TYPED = "import sys; from instrument.cli import main; sys.exit(main(sys.argv[1:]))"


def bench_of(routine: str) -> str:
    """Return the bench that a routine is told and taken on, in real time."""
    return BENCHES.get(routine, BENCH).replace("time_scale = 0.0", "time_scale = 1.0")


def carried_out(routine: str, words: list[str], folder: Path, *, compiled: bool) -> tuple[float, str]:
    """Return the seconds by the clock that a routine took, from its first words on, and what it said."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "PYTHONUNBUFFERED": "1",
        "XDG_CACHE_HOME": str(folder / "cache"),
    }
    if not compiled:
        environment["NUMBA_CACHE_DIR"] = str(folder / "kernels")
    said, began_s = [], 0.0
    with subprocess.Popen(
        [sys.executable, "-c", TYPED, "calibrate", routine, *words],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        for line in process.stdout or ():
            began_s = began_s or time.monotonic()
            said.append(line)
    if process.returncode:
        raise SystemExit(f"calibrate {routine} ended with {process.returncode}:\n{''.join(said)}")
    return time.monotonic() - began_s, "".join(said)


def by_the_processor(enough_s: float) -> None:
    """Print what is told of the screen and what it then takes, both in processor seconds of one thread."""
    set_threads(1)
    rehearsal.time = SimpleNamespace(perf_counter=time.process_time)  # type: ignore[assignment, attr-defined]
    rehearsal.ENOUGH_S = enough_s
    routine = routines["screen"]
    asked = routine.options()
    procedure = routine.procedure(asked)
    with open_bench(parse_config(template("screen"), None)) as bench, tempfile.TemporaryDirectory() as made:
        work = procedure.outlook(bench).work
        print(*rehearsal.rehearse_whole(routine, asked, bench, lambda *_: None, work), flush=True)
        began_s = time.process_time()
        procedure.carry_out(bench, Path(made))
        print(f"It took {time.process_time() - began_s:.1f} processor seconds.")


def told_by(said: str) -> str:
    """Return the sentence with the time."""
    found = re.search(r"^(In all, |Up to the end of ).*", said, re.MULTILINE)
    return found[0] if found else "nothing"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(ROUTINES), default=list(ROUTINES))
    parser.add_argument("--compiled", action="store_true", help="with the kernels that are there")
    parser.add_argument("--processor", type=float, help="seconds after which a rehearsal ends")
    asked = parser.parse_args()
    if asked.processor is not None:
        by_the_processor(asked.processor)
        return
    print("| `calibrate` | told | took, s | load |\n|---|---|---|---|", flush=True)
    for routine, typed in ((name, typed) for name in asked.only for typed in ROUTINES[name]):
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            (folder / "bench.toml").write_text(bench_of(routine))
            words = typed.split()
            before = os.getloadavg()[0]
            _, said = carried_out(routine, [*words, "--dry-run"], folder, compiled=asked.compiled)
            took_s, _ = carried_out(routine, words, folder, compiled=asked.compiled)
            print(
                f"| {' '.join((f'`{routine}`', *words))} | {told_by(said)} | {took_s:.1f} | "
                f"{before:.0f} to {os.getloadavg()[0]:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
