"""Round-trip rates and command latencies of the drivers, each over its emulator.

    python benchmarks/driver_latency.py

Emulators answer at once, so this is what the driver, the transport and the kernel's pseudo-terminal cost:
real controllers add their own time (and 1 to 16 ms of latency in a USB serial adapter). A round trip is one
question with its answer. STOP is timed from the call of ``stop`` or ``off`` to its return, in the middle of a
move or of other commands. ``display`` is timed without ``settle_ms``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the emulators are among the tests

from drivers.apt.stage import AptOptions, AptStage
from drivers.dlpc900.slm import Dlpc900Options, Dlpc900Slm
from drivers.grbl.stage import GrblOptions, GrblStage
from drivers.illuminate.led_array import IlluminateLedArray, IlluminateOptions
from drivers.led_array import LedArray
from drivers.second_display.outputs import SecondDisplayOptions
from drivers.second_display.slm import SecondDisplaySlm
from drivers.slm import Slm
from drivers.stage import Stage
from drivers.zaber.stage import ZaberOptions, ZaberStage
from tests.mocks.apt_controller import AptController
from tests.mocks.dlpc900_device import Dlpc900Emulator, FakeHidraw
from tests.mocks.grbl_controller import GrblController
from tests.mocks.illuminate_emulator import IlluminateEmulator
from tests.mocks.moving_axis import MovingAxis
from tests.mocks.zaber_chain import ZaberChain

Row = tuple[str, str, str, str]


def median_ms(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return median and 95th percentile of how long a call takes after the first, milliseconds."""
    taken: list[float] = []
    call()
    for _ in range(repeats):
        began_s = time.perf_counter()
        call()
        taken.append(1e3 * (time.perf_counter() - began_s))
    return float(np.median(taken)), float(np.quantile(taken, 0.95))


def words(times: tuple[float, float]) -> str:
    """Return median and 95th percentile as the table has them."""
    return f"{times[0]:.3g} ({times[1]:.3g})"


def rate(times: tuple[float, float]) -> str:
    """Return round trips a second."""
    return f"{1e3 / times[0]:.0f}"


def stage_row(name: str, stage: Stage, repeats: int) -> Row:
    """Time asking where it is, starting a move, and STOP in the middle of one."""
    stage.home()
    axis = stage.axes[0]
    ends = [axis.lower_limit + share * (axis.upper_limit - axis.lower_limit) for share in (0.1, 0.9)]
    asked = median_ms(stage.position, repeats)
    starts, stops = [], []
    for turn in range(max(3, repeats // 20)):
        began_s = time.perf_counter()
        stage.move_to({axis.name: ends[turn % 2]}, wait=False)
        starts.append(1e3 * (time.perf_counter() - began_s))
        time.sleep(0.03)
        began_s = time.perf_counter()
        stage.stop()
        stops.append(1e3 * (time.perf_counter() - began_s))
    return name, rate(asked), f"move {np.median(starts):.3g}", f"{np.median(stops):.3g}"


def led_row(name: str, leds: LedArray, repeats: int) -> Row:
    """Time a question, one LED, and ``off`` while another thread sends patterns."""
    asked = median_ms(leds.settings, repeats)
    first, second = leds.single(0), leds.single(1)
    shown = median_ms(lambda: (leds.set_pattern(first), leds.set_pattern(second)), repeats // 2)
    offs = []
    for _ in range(max(3, repeats // 20)):
        done = threading.Event()

        def busy(done: threading.Event = done) -> None:
            while not done.is_set():
                try:
                    leds.set_pattern(first)
                except Exception:  # noqa: BLE001 - the light was turned off meanwhile: as it should be
                    return

        thread = threading.Thread(target=busy)
        thread.start()
        time.sleep(0.02)
        began_s = time.perf_counter()
        leds.off()
        offs.append(1e3 * (time.perf_counter() - began_s))
        done.set()
        thread.join()
    pattern = words((shown[0] / 2, shown[1] / 2))
    return name, rate(asked), f"pattern {pattern}", f"{np.median(offs):.3g}"


def slm_row(name: str, slm: Slm, repeats: int) -> Row:
    """Time a blank pattern and one of random squares; a round trip is a blank pattern, confirmed."""
    rng = np.random.default_rng(0)
    height, width = slm.shape
    squares = np.kron(rng.integers(0, 2, (height // 8 + 1, width // 8 + 1)), np.ones((8, 8)))
    levels = (255 * squares[:height, :width]).astype(np.uint8)
    blank = median_ms(slm.blank, max(3, repeats // 20))
    shown = median_ms(lambda: slm.display(levels), max(3, repeats // 20))
    return name, rate(blank), f"blank {words(blank)}; squares {words(shown)}", ""


@contextmanager
def two_screens(folder: Path) -> Iterator[None]:
    """Let Qt draw offscreen on two screens, the second of 1920 x 1080."""
    dpi = {"logicalDpi": 96, "logicalBaseDpi": 96, "dpr": 1, "y": 0}
    desk = {"name": "DESK", "x": 0, "width": 800, "height": 600} | dpi
    slm = {"name": "SLM", "x": 800, "width": 1920, "height": 1080} | dpi
    (folder / "screens.json").write_text(json.dumps({"screens": [desk, slm]}))
    with patch.dict(os.environ, {"QT_QPA_PLATFORM": f"offscreen:configfile={folder / 'screens.json'}"}):
        yield


def rows(folder: Path, repeats: int) -> Iterator[Row]:
    """Measure driver after driver."""
    with ExitStack() as stack:

        def place(name: str) -> Path:
            (folder / name).mkdir()
            return folder / name

        motion = MovingAxis(0, 400_000, 100_000.0)
        servo = AptController(place("apt"), "KDC101", [motion])
        stack.callback(servo.close)
        axis = {"port": str(servo.port.link), "controller": "KDC101", "actuator": "Z806"}
        apt = AptStage(AptOptions.model_validate({"axes": {"x_um": axis}}))
        yield stage_row("apt.stage (KDC101)", stack.enter_context(apt), repeats)

        grbl = GrblController(place("grbl"))
        stack.callback(grbl.unplug)
        stage: Stage = GrblStage(GrblOptions.model_validate({"port": str(grbl.link)}))
        yield stage_row("grbl.stage", stack.enter_context(stage), repeats)

        chain = ZaberChain(place("zaber"))
        stack.callback(chain.close)
        table = {"device": 1, "axis": 1, "microstep_um": 0.5}
        stage = ZaberStage(
            ZaberOptions.model_validate({"port": str(chain.port.link), "axes": {"x_um": table}})
        )
        yield stage_row("zaber.stage", stack.enter_context(stage), repeats)

        for version in ("1.32", "2.32"):
            array = IlluminateEmulator(place(version), version)
            stack.callback(array.unplug)
            leds = IlluminateLedArray(IlluminateOptions(port=str(array.link)))
            yield led_row(f"illuminate.led_array ({version})", stack.enter_context(leds), repeats)

        with patch.dict(sys.modules, {"hidraw": FakeHidraw(Dlpc900Emulator())}):  # type: ignore[dict-item]
            slm: Slm = Dlpc900Slm(Dlpc900Options(settle_ms=0))
            yield slm_row("dlpc900.slm (1920 x 1080)", stack.enter_context(slm), repeats)
        with two_screens(folder):
            options = SecondDisplayOptions(output="SLM", pixel_pitch_um=8, settle_ms=0, refreshes_to_wait=0)
            yield slm_row(
                "second_display.slm (1920 x 1080)", stack.enter_context(SecondDisplaySlm(options)), repeats
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--repeats", type=int, default=200)
    repeats = parser.parse_args().repeats
    print(
        "| driver | round trips a second | command, ms: median (95 %) | STOP or off, ms |\n|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(Path(folder), repeats):
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
