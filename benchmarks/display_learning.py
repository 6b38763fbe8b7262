"""What a display model learned from photographs of random patterns gains, with errors and without.

    python benchmarks/display_learning.py --out display-learning.csv
    python benchmarks/display_learning.py --expansion 16 --only errors
    python benchmarks/display_learning.py --only errors --rounds 5

SIMULATED: a display of 192 x 108 SLM pixels (:data:`ERRORS`, or none), its look-up table right, 8-bit phase,
lens distortion, a camera off the axis, noise. It is learned from random patterns, as ``calibrate display``
does. Then pictures that were not fitted are computed by the description and by what was learned, shown and
photographed. With ``--rounds`` the camera goes on from each with the first picture. Processor seconds include
the bench's simulation; learning is given apart.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from calibration_routines.display.display_io import DisplayBench, require_slm
from calibration_routines.display.display_learning import ASIDE
from calibration_routines.display.hologram_photograph import HologramCamera
from calibration_routines.display.pattern_series import photograph_series
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.display.bench_display import bench_display
from instrument.display.hologram import CaptureOptions, prepare_target
from instrument.files.sample_images import load_sample
from recon.base.threads import set_threads
from recon.holography import HologramModel, compute_hologram
from recon.holography.learn import learn_display
from recon.holography.pose import NODES

PICTURES = ("portrait", "leaves")
BENCH = """\
[bench]
name = "display learning"
[camera]
driver = "simulated_display"
[slm]
driver = "simulated_display"
shape = [{height}, {width}]
[scene]
control = "simulated"
[display]
slm_binning = {binning}
expansion = {expansion}
mask_seed = {seed}
mask_fill = 1.0
wavelength_nm = 660.0
focal_mm = 35.0
dc_power = 0.1
dc_phase_rad = 0.6
[simulated_display]
seed = {seed}
mask_seed = {seed}
wavefront_seed = {seed}
time_scale = 0.0
z_um = 0.0
roll_mrad = 0.0
pitch_mrad = 0.0
yaw_mrad = 0.0
magnification = 0.0
"""
ERRORS = """\
shift_um = [0.3, -0.2]
relay_distortion_um = 0.6
dc_power = 0.14
dc_phase_rad = 0.9
fill = 0.93
flatness_rad = 0.5
amplitude_swing = 0.15
crosstalk_px = 0.15
beam_mm = {beam_mm}
beam_centre_um = [80.0, -40.0]
wavefront_rad = 0.8
vignetting = 0.3
mask_depth = 0.92
mask_roughness_rad = 0.1
"""
"""Beyond the description; the shift is a tenth of a mask pixel."""
PERFECT = """\
shift_um = [0.0, 0.0]
relay_distortion_um = 0.0
dc_power = 0.1
dc_phase_rad = 0.6
fill = 1.0
"""
KINDS = {"errors": BENCH + ERRORS, "perfect": BENCH + PERFECT}
Line = dict[str, object]


def configuration(kind: str, expansion: int, seed: int) -> str:
    """Return bench.toml; mask pixels are always 4 um, the beam grows with the SLM pixels."""
    binning = {4: 1, 16: 2}[expansion]
    sizes = {"height": 108 * binning, "width": 192 * binning, "beam_mm": 0.9 * binning}
    return KINDS[kind].format(**sizes, binning=binning, expansion=expansion, seed=seed)


def one_display(kind: str, options: argparse.Namespace, expansion: int) -> list[Line]:
    """Learn one display and photograph all pictures by both models."""
    began = time.process_time()
    head = f"{expansion}x, {kind}"
    config = parse_config(configuration(kind, expansion, options.seed), None)
    with open_bench(config) as bench:
        slm = require_slm(bench)
        known = bench_display(config, (slm.shape, slm.pixel_pitch_um))
        io = DisplayBench(bench, config.display.slm_binning)
        seen = HologramCamera.registered(io, replace(known, displacement=np.zeros((*NODES, 2))))
        looks = photograph_series(seen, options.patterns, seed=options.seed).looks
        photographs = io.frames
        learning = time.process_time()
        print(f"{head}: {photographs} photographs, {learning - began:.0f} CPU s; learning", flush=True)
        lesson = learn_display(seen.display, looks, aside=ASIDE)
        learning = time.process_time() - learning
        print(
            f"{head}: learned in {learning:.0f} CPU s; not explained of the contrast of {ASIDE} photographs "
            f"that were not fitted: {lesson.before**2:.1%} before, {lesson.after**2:.1%} after",
            flush=True,
        )
        lines: list[Line] = []
        for name in PICTURES:
            pixels = np.rint(255 * load_sample(name, (256, 256))).astype(np.uint8)
            wanted = prepare_target(pixels, known)
            line: Line = {"expansion": expansion, "display": kind, "picture": name}
            for words, display in (("described", seen.display), ("learned", lesson.display)):
                model = HologramModel(display, [prepare_target(pixels, display)])
                pattern = compute_hologram(model, iterations=options.iterations).slm
                camera = replace(seen, display=display)
                found = camera.capture(list(pattern), wanted, average=2)
                line[f"{words}_db"] = round(found.scores.psnr_db, 2)
                said = f"{found.scores.psnr_db:.2f} dB, SSIM {found.scores.ssim:.3f}"
                if options.rounds and name == PICTURES[0]:
                    asked = CaptureOptions(average=2, refine=options.rounds)
                    refined = camera.refine(pattern, wanted, asked)
                    line[f"{words}_loop_db"] = round(refined.best.scores.psnr_db, 2)
                    said += ", camera in the loop " + ", ".join(f"{db:.2f}" for db in refined.psnr_db)
                print(f"{head}: {name}, {words}: {said}", flush=True)
            lines.append(line)
    shared = {
        "photographs": photographs,
        "unexplained_before": round(lesson.before**2, 4),
        "unexplained_after": round(lesson.after**2, 4),
        "learning_cpu_s": round(learning),
        "cpu_s": round(time.process_time() - began),
    }
    return [line | shared for line in lines]


def main() -> None:
    """Run all and write the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=list(KINDS), help="one of the two displays")
    parser.add_argument("--expansion", type=int, nargs="+", choices=[4, 16], default=[4])
    parser.add_argument("--patterns", type=int, default=13, help=f"random ones; {ASIDE} of them judge")
    parser.add_argument("--iterations", type=int, default=50, help="of each hologram")
    parser.add_argument("--rounds", type=int, default=0, help="with the camera in the loop")
    parser.add_argument("--seed", type=int, default=0, help="of errors, mask, noise and patterns")
    parser.add_argument("--out", type=Path, default=Path("display-learning.csv"))
    options = parser.parse_args()
    set_threads(1)
    lines: list[Line] = []
    for expansion in options.expansion:
        for kind in (options.only,) if options.only else KINDS:
            lines += one_display(kind, options, expansion)
            write(options.out, lines)
    print("\n| SIMULATED | " + " | ".join(lines[0]) + " |\n|" + "---|" * (len(lines[0]) + 1))
    for line in lines:
        print("| | " + " | ".join(str(line.get(name, "")) for name in lines[0]) + " |")


def write(path: Path, lines: list[Line]) -> None:
    """Write one line a picture."""
    names = list(dict.fromkeys(name for line in lines for name in line))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(lines)


if __name__ == "__main__":
    main()
