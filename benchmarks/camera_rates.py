"""Frames a second that the camera drivers get, against what the source offers, with every lost frame counted.

    python benchmarks/camera_rates.py [--seconds 5] [--only aravis|gige|v4l2|unpack]

Aravis' fake camera in process; the same in a process of its own over GigE Vision on the loopback interface;
the kernel's vivid camera in the virtual machine of tests/kernel_vm (a slow, emulated computer; run its
setup.sh first); packed pixels unpacked. Frames are read as an acquisition reads them, through a stream with a
ring of buffers. "Offered": what the source numbered in that time, which on a busy computer is less than its
rate; "lost": of those, by the driver's count from frame numbers and from buffers without room.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from drivers.aravis.camera import AravisCamera
from drivers.camera import Camera, Roi
from drivers.common.pixels import Packing, PixelFormat, unpack
from drivers.v4l2.camera import V4l2Camera

_REPOSITORY = Path(__file__).parents[1]
_NODE = "/dev/video0"
_RING = 32


def report(name: str, camera: Camera, frames_per_s: float, seconds: float) -> None:
    """Stream for a while and print what came."""
    with camera.stream(n_buffers=_RING) as stream:
        reader = stream.reader()
        first = reader.next_frame(30.0)
        assert first is not None
        began_s, began_cpu_s = time.monotonic(), time.process_time()
        last = first
        while time.monotonic() - began_s < seconds:
            frame = reader.next_frame(30.0)
            assert frame is not None
            last = frame
        passed_s = time.monotonic() - began_s
        busy = (time.process_time() - began_cpu_s) / passed_s
        status = reader.status
    lost = status.dropped_by_device + status.overwritten
    got = status.delivered - 1
    offered = got + lost
    shape = " x ".join(map(str, last.image.shape))
    print(
        f"{name:34} {shape:>10} {camera.pixel_format:8} {frames_per_s:6.4g} {got / passed_s:7.1f} "
        f"{offered:8d} {got:6d} {lost:6d} {100 * busy:5.0f} %",
        flush=True,
    )


def aravis_rates(name: str, device_id: str, rates: tuple[float, ...], seconds: float) -> None:
    """Report on a camera of Aravis at several frame rates and two pixel formats."""
    for rate in rates:
        options = AravisCamera.Options(device_id=device_id, pixel_pitch_um=3.0, frames_per_s=rate)
        with AravisCamera(options) as camera:
            camera.set_exposure_ms(1.0)
            camera.set_roi(Roi(0, 0, 512, 512))
            for pixel_format in ("Mono8", "Mono16"):
                camera.set_pixel_format(pixel_format)
                report(name, camera, rate, seconds)


@contextmanager
def gige_camera(address: str) -> Iterator[None]:
    """Run Aravis' fake camera in a process of its own."""
    process = subprocess.Popen(["arv-fake-gv-camera-0.8", "-i", address, "-s", "GV01"])
    time.sleep(0.5)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def vivid_rates(seconds: float) -> None:
    """Report on the kernel's vivid camera, or whatever else is the first video device."""
    for shape, rate in (((180, 320), 60.0), ((360, 640), 40.0), ((720, 1280), 15.0)):
        options = V4l2Camera.Options(device=_NODE, pixel_pitch_um=3.0, input=0, size=shape, frames_per_s=rate)
        with V4l2Camera(options) as camera:
            for pixel_format in ("Mono8", "Mono12"):
                camera.set_pixel_format(pixel_format)
                report(f"V4L2, {camera.identity.model} in the VM", camera, 1 / camera._period_s, seconds)


def v4l2(seconds: float) -> None:
    """Report on the kernel's camera, in the virtual machine when this computer has none."""
    if Path(_NODE).exists():
        vivid_rates(seconds)
        return
    here = [
        sys.executable,
        str(Path(__file__).relative_to(_REPOSITORY)),
        "--only",
        "v4l2",
        "--seconds",
        str(seconds),
    ]
    run = _REPOSITORY / "tests" / "kernel_vm" / "run.sh"
    env = dict(os.environ, KERNEL_VM_SECONDS="600")
    done = subprocess.run(
        [str(run), *here], cwd=_REPOSITORY, env=env, stdout=subprocess.PIPE, text=True, check=False
    )
    print("".join(line for line in done.stdout.splitlines(True) if line.startswith("V4L2")), end="")
    if done.returncode:
        sys.exit(f"The virtual machine failed ({done.returncode}):\n{done.stdout[-2000:]}")


def unpacking() -> None:
    """Report how fast packed pixels are unpacked, 4 megapixels at a time."""
    out = np.empty((2048, 2048), np.uint16)
    packings: tuple[Packing, ...] = ("words", "lsb 12", "gige 12", "mipi 12", "lsb 10", "gige 10", "mipi 10")
    for packing in packings:
        n_bytes = PixelFormat("", 12, packing).line_bytes(out.size)
        data = np.random.default_rng(0).integers(0, 256, n_bytes, np.uint8)
        times = []
        for _ in range(7):
            began_s = time.perf_counter()
            unpack(data, packing, out)
            times.append(time.perf_counter() - began_s)
        print(
            f"unpacking {packing:8} {out.size / 1e6 / float(np.median(times)):7.0f} megapixels a second",
            flush=True,
        )


def main() -> None:
    """Print one line a camera, format and frame rate."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="how long each is read")
    parser.add_argument("--only", choices=["aravis", "gige", "v4l2", "unpack"], help="one part alone")
    arguments = parser.parse_args()
    parts = [arguments.only] if arguments.only else ["aravis", "gige", "v4l2", "unpack"]
    print(
        f"{'camera':34} {'frame':>10} {'format':8} {'rate':>6} {'got/s':>7} {'offered':>8} {'got':>6} "
        f"{'lost':>6} {'CPU':>7}"
    )
    if "aravis" in parts:
        aravis_rates("Aravis, fake in process", "Fake_1", (100.0, 200.0), arguments.seconds)
    if "gige" in parts:
        with gige_camera("127.0.0.1"):
            aravis_rates("Aravis, GigE Vision on loopback", "127.0.0.1", (50.0, 100.0), arguments.seconds)
    if "v4l2" in parts:
        v4l2(arguments.seconds)
    if "unpack" in parts:
        unpacking()


if __name__ == "__main__":
    main()
