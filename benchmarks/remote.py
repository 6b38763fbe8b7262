"""What a served device costs: round trips, STOP, frames; over loopback and over a slow network.

    python benchmarks/remote.py

``diffuserbench serve`` runs as a program of its own on the simulated bench. *slow* is the same through a
relay that delays everything by 20 ms each way and carries 10 MB/s on each connection. A round trip is one
property read. STOP is timed from the call to its return, the stage being at rest or the light off by then, in
the middle of a move, with and without a camera streaming beside it; what it takes beyond a round trip,
measured among the same traffic, is the server's.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the network is among the tests

from drivers.camera import Camera
from drivers.errors import StoppedError
from drivers.remote.camera import RemoteCamera
from drivers.remote.light_and_motion import RemoteLedArray, RemoteStage
from drivers.remote.options import RemoteOptions
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from tests.mocks.bad_network import BadNetwork

BENCH = """
[simulated]
preset = "{preset}"
scene = "none"
[camera]
driver = "simulated"
replay_frames = 8
frames_per_s = {rate}
exposure_ms = 1.0
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
"""
REPEATS = 60


@contextmanager
def serve(text: str, folder: Path) -> Iterator[int]:
    """Yield the port of a server in a program of its own."""
    bench = folder / "bench.toml"
    bench.write_text(text)
    command = [sys.executable, "-c", "import sys; from instrument.cli import main; sys.exit(main())"]
    command += ["serve", "--bench", str(bench), "--port", "0", "--token-file", str(folder / "token")]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1]
    ) as server:
        assert server.stdout is not None
        try:
            for line in server.stdout:
                if found := re.match(r"Page: .*:(\d+)/#", line):
                    yield int(found[1])
                    return
            raise RuntimeError("the server did not start")
        finally:
            server.terminate()


def times_ms(call: Callable[[], object], repeats: int = REPEATS) -> list[float]:
    """Return how long a call takes after the first, milliseconds."""
    call()
    taken = []
    for _ in range(repeats):
        began_s = time.perf_counter()
        call()
        taken.append(1e3 * (time.perf_counter() - began_s))
    return taken


def stops_ms(stage: RemoteStage, repeats: int) -> list[float]:
    """Return how long STOP takes in the middle of moves."""
    taken = []
    low, high = stage.limits["x_um"]
    for n in range(repeats):
        target = (low, high)[n % 2]

        def move(target: float = target) -> None:
            with suppress(StoppedError):
                stage.move_to({"x_um": target})

        moving = threading.Thread(target=move)
        moving.start()
        while not stage.is_moving:
            pass
        began_s = time.perf_counter()
        stage.stop()
        taken.append(1e3 * (time.perf_counter() - began_s))
        assert not stage.is_moving
        moving.join()
    return taken


def offs_ms(leds: RemoteLedArray, repeats: int) -> list[float]:
    """Return how long switching the light off takes.

    It is dark already: the simulated camera computes for many milliseconds what it sees of another light.
    """
    return times_ms(leds.off, repeats)


def words(taken: list[float]) -> str:
    """Return median and 95th percentile."""
    return f"{np.median(taken):.2f} ({np.quantile(taken, 0.95):.1f})"


def rate(camera: Camera, seconds: float) -> tuple[float, int, int]:
    """Return frames a second, frames got and frames lost."""
    with camera.stream(32) as stream:
        reader = stream.reader()
        reader.next_frame()
        began_s, got = time.perf_counter(), 0
        while time.perf_counter() < began_s + seconds:
            got += reader.next_frame() is not None
        lost = reader.status.dropped_by_device + reader.status.overwritten
    return got / seconds, got, lost


def latencies(port: int, token: Path, label: str) -> None:
    """Print the rows of one network."""
    with ExitStack() as stack:
        options = RemoteOptions(url=f"http://127.0.0.1:{port}", token_file=str(token))
        camera = stack.enter_context(RemoteCamera(options))
        stage = stack.enter_context(RemoteStage(options))
        leds = stack.enter_context(RemoteLedArray(options))
        camera.set_exposure_ms(1.0)
        stage.home()
        for streaming in (False, True):
            frames = stack.enter_context(camera.stream()) if streaming else None
            if frames is not None:
                frames.wait_newer(None, 30.0)
            trips, moves, lights = times_ms(stage.position), stops_ms(stage, 20), offs_ms(leds, REPEATS)
            beside = "a camera streaming beside it" if streaming else "nothing else"
            beyond = max(np.quantile(moves, 0.95), np.quantile(lights, 0.95)) - np.median(trips)
            print(
                f"| {label} | {beside} | {words(trips)} | {words(moves)} | {words(lights)} | {beyond:.0f} |",
                flush=True,
            )


def main() -> None:
    """Print both tables."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        print(
            "| network | beside | round trip, ms: median (95 %) | STOP of a move | light off "
            "| beyond a round trip, 95 % |"
        )
        print("|---|---|---|---|---|---|")
        text = BENCH.format(preset="pco", rate=30.0)
        with serve(text, folder) as port:
            latencies(port, folder / "token", "loopback")
            with BadNetwork(port) as slow:
                slow.delay_s, slow.bytes_per_s = 0.02, 10e6
                latencies(slow.port, folder / "token", "slow")
        print(
            "\n| camera | frames asked a second | own driver: got, lost | served: got, lost | MB/s served |"
        )
        print("|---|---|---|---|---|")
        for preset, asked in (("tiny", 500.0), ("pco", 30.0)):
            text = BENCH.format(preset=preset, rate=asked)
            with Bench(parse_config(text, None)).open() as bench:
                shape = bench.camera.image_shape
                own = rate(bench.camera, 5.0)
            with serve(text, folder) as port:
                options = RemoteOptions(url=f"http://127.0.0.1:{port}", token_file=str(folder / "token"))
                with RemoteCamera(options) as camera:
                    camera.set_exposure_ms(1.0)
                    served = rate(camera, 5.0)
            print(
                f"| {shape[0]} x {shape[1]} | {asked:g} | {own[0]:.1f}/s, {own[2]} "
                f"| {served[0]:.1f}/s, {served[2]} | "
                f"{served[0] * 2 * shape[0] * shape[1] / 1e6:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
