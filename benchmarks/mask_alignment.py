"""Mask alignment from random starts on the simulated display, which knows the truth and does not tell.

Each start draws shift, depth, rotation, tilts, relay magnification and distortion (up to 1.5 mask pixels at
the corners, about an axis up to 0.8 mm off), with DC term, pixel fill, lens distortion, camera offset, noise
and 8-bit phase always on; the procedure is told none of it. Afterwards a hologram is photographed: computed
for a perfectly placed mask and shown before aligning, computed with the pose found, and computed with the
truth for a bench without misalignment. ``pull_*`` are errors over the uncertainties that were stated. With
``--hard`` the camera is turned by up to 150 mrad, its noise is physical or ten times that, the picture shakes
by 0, 0.25, 0.5 or 1 um, and every sixth start has a laser of another wavelength than [display] says, by 1 %,
which is to be refused for that. ``--slm`` takes a smaller SLM (rotations stay as large at the edge), and
``--no-pictures`` leaves the photographs out. Writes a line a start; run again, it goes on where it ended::

    python benchmarks/mask_alignment.py --starts 20 --out mask-alignment
    python benchmarks/mask_alignment.py --kind tilt --starts 4 --out alone-tilt
    python benchmarks/mask_alignment.py --hard --starts 60 --out mask-alignment-hard
    python benchmarks/mask_alignment.py --hard --starts 60 --slm 180x320 --no-pictures --out small
"""

from __future__ import annotations

import argparse
import csv
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.hologram_photograph import HologramCamera
from calibration_routines.display.mask_alignment import (
    AlignmentFailedError,
    AlignmentReport,
    MaskAlignment,
)
from drivers.simulated.display import SENSOR, DisplayWorld
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config, template
from instrument.display.bench_display import bench_display
from instrument.display.hologram import prepare_target
from instrument.files.sample_images import load_sample
from recon.holography import DcTerm, Display, HologramModel, compute_hologram
from recon.holography.camera_map import register_camera
from recon.holography.pose import NAMES, NODES, Pose, nodes_of
from recon.holography.sections import split_field

ITERATIONS = 30


KINDS = {
    "shift": ("shift_um",),
    "depth": ("z_um",),
    "rotation": ("roll_mrad",),
    "tilt": ("pitch_mrad", "yaw_mrad"),
    "magnification": ("magnification",),
    "distortion": ("relay_distortion_um", "relay_centre_um"),
}


SLM = (360, 640)
"""Of the template, pixels; it shows two by two as one, behind which are four by four of the mask."""
FINER = 8
FINE = tuple(FINER * (n - 1) + 1 for n in NODES)
"""Places at which displacements are compared: between nodes they are straight, a distortion is not."""


def draw(seed: int, kind: str = "all", slm: tuple[int, int] = SLM) -> dict[str, str]:
    """Return the options of one start; ``kind`` leaves everything else at zero."""
    options = _draw(seed, slm[1] / SLM[1])
    for other, names in KINDS.items():
        if kind not in ("all", other):
            options |= {name: "[0.0, 0.0]" if options[name].startswith("[") else "0.0" for name in names}
    return options


def _draw(seed: int, size: float) -> dict[str, str]:
    rng = np.random.default_rng(1000 + seed)
    x, y = rng.uniform(-288, 288, 2)  # 72 mask pixels of 4 um
    half_width = 640.0 * size  # mask pixels
    return {
        "seed": str(seed),
        "shift_um": f"[{x:.2f}, {y:.2f}]",
        "z_um": f"{rng.uniform(-1000, 1000):.1f}",
        "roll_mrad": f"{rng.uniform(-4, 4) / half_width * 1e3:.4f}",
        "pitch_mrad": f"{rng.uniform(-5, 5):.3f}",
        "yaw_mrad": f"{rng.uniform(-5, 5):.3f}",
        "magnification": f"{rng.uniform(-0.003, 0.003):.6f}",
        "relay_distortion_um": f"{rng.uniform(-6, 6):.2f}",
        "relay_centre_um": "[{:.0f}, {:.0f}]".format(*(size * rng.uniform(-800, 800, 2))),
    }


def hardships(seed: int) -> dict[str, str]:
    """Return what makes a start hard beyond where the mask is."""
    rng = np.random.default_rng(2000 + seed)
    wrong = 660.0 * (1 + 0.01 * rng.choice([-1, 1])) if seed % 6 == 5 else 660.0
    return {
        "sensor_roll_mrad": f"{rng.uniform(-150, 150):.1f}",
        "noise": f"{rng.choice([1.0, 10.0])}",
        "vibration_px": f"{rng.choice([0.0, 0.25, 0.5, 1.0]) / SENSOR.pitch_um:.4f}",
        "wavelength_nm": f"{wrong:.2f}",
    }


def configuration(options: dict[str, str], slm: tuple[int, int] = SLM) -> str:
    """Return bench.toml of the simulated display with some options of the last table replaced or added."""
    text = template("display").replace(f"shape = [{SLM[0]}, {SLM[1]}]", f"shape = [{slm[0]}, {slm[1]}]")
    head, tail = text.split("\n[simulated_display]")
    for key, value in options.items():
        tail, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", tail)
        if not count:
            tail = f"{tail.rstrip()}\n{key} = {value}\n"
    return f"{head}\n[simulated_display]{tail}"


def true_pose(world: DisplayWorld) -> Pose:
    """Return the true pose, without the relay's distortion."""
    pose, options = world.pose(), world.options
    pitch = options.mask_pitch_um
    return Pose(
        pose.shift_x_um / pitch,
        pose.shift_y_um / pitch,
        pose.roll_mrad,
        options.magnification,
        0.0,
        pose.z_um,
        pose.pitch_mrad,
        pose.yaw_mrad,
    )


def true_displacement(world: DisplayWorld, mask_shape: tuple[int, int]) -> np.ndarray:
    """Return the true displacement, distorted as the simulated relay does it, as :func:`everywhere`."""
    options = world.options
    field = everywhere(true_pose(world).displacement(mask_shape))
    y, x = nodes_of(mask_shape, FINE)
    centre_x, centre_y = (c / options.mask_pitch_um for c in options.relay_centre_um)
    across, down = x + field[..., 1] - centre_x, y + field[..., 0] - centre_y
    cubic = options.relay_distortion_um / options.mask_pitch_um / (0.5 * np.hypot(*mask_shape)) ** 3
    stretch = cubic * (across**2 + down**2)
    return field + np.stack([stretch * down, stretch * across], axis=-1)


def everywhere(field: np.ndarray) -> np.ndarray:
    """Return a displacement between its nodes as well, where it is straight: as holograms are made with."""
    from scipy.ndimage import zoom

    return np.asarray(zoom(field, [*(n / m for n, m in zip(FINE, NODES, strict=True)), 1], order=1))


def residual(world: DisplayWorld, found: np.ndarray, mask_shape: tuple[int, int]) -> float:
    """Return the rms distance between true and found displacement over the mask, mask pixels."""
    difference = true_displacement(world, mask_shape) - everywhere(found)
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=-1))))


def hologram(display: Display, target: object) -> np.ndarray:
    """Compute a hologram."""
    model = HologramModel(display, [target])  # type: ignore[list-item]
    return compute_hologram(model, iterations=ITERATIONS).slm[0]


def pulls(world: DisplayWorld, report: AlignmentReport, mask_shape: tuple[int, int]) -> dict[str, float]:
    """Return each parameter's error over the uncertainty that was stated for it."""
    true, _ = split_field(true_displacement(world, mask_shape), mask_shape)
    found, _ = split_field(everywhere(report.displacement(mask_shape)), mask_shape)
    deep = [NAMES.index(name) for name in ("z_um", "pitch_mrad", "yaw_mrad")]
    true[deep], found[deep] = true_pose(world).vector()[deep], report.pose.vector()[deep]
    known = zip(NAMES, found - true, report.error, strict=True)
    return {f"pull_{name}": round(float(off / error), 2) for name, off, error in known if name != "cubic"}


def one_start(
    seed: int,
    kind: str,
    plain: np.ndarray | None,
    hard: dict[str, str],
    slm: tuple[int, int] = SLM,
    *,
    pictures: bool = True,
) -> tuple[dict[str, object], np.ndarray | None]:
    """Run one start; ``plain`` is the hologram for a perfectly placed mask."""
    options = draw(seed, kind, slm) | hard
    config = parse_config(configuration(options, slm), None)
    line: dict[str, object] = {"start": seed, "kind": kind, **options}
    with Bench(config).open() as bench:
        assert bench.stage is not None
        assert bench.slm is not None
        bench.stage.home()
        (world,) = bench.shared.values()
        assert isinstance(world, DisplayWorld)
        known = bench_display(config, (bench.slm.shape, bench.slm.pixel_pitch_um))
        target = prepare_target((load_sample("leaves", (512, 512)) * 255).astype(np.uint8), known)
        if pictures and plain is None:
            plain = hologram(known, target)
        io = DisplayBench(bench, config.display.slm_binning)
        alignment = MaskAlignment(io, replace(known, dc=DcTerm(0.0)))
        began = time.process_time()
        try:
            report = alignment.run()
        except AlignmentFailedError as error:
            cpu_s = round(time.process_time() - began, 1)
            line |= {"success": False, "said": str(error), "frames": io.frames, "cpu_s": cpu_s}
            return line, plain
        shape = known.mask.shape
        left = true_pose(world)
        field = report.displacement(shape)
        line |= {
            "success": True,
            "frames": report.frames,
            "cpu_s": round(time.process_time() - began, 1),
            "efficiency": round(report.efficiency, 3),
            "predicted_lost_db": round(report.psnr_lost_db, 2),
            "repeatability_db": round(report.repeatability_db, 2),
            "residual_px": round(residual(world, field, shape), 3),
            "z_left_um": round(left.z_um, 1),
            "tilt_left_mrad": round(float(np.hypot(left.pitch_mrad, left.yaw_mrad)), 2),
            "said": "; ".join(report.findings),
            **pulls(world, report, shape),
        }
        if plain is None:
            return line, None
        aligned = replace(known, displacement=field)
        mean_per_ms = report.brightness_per_ms
        seen = HologramCamera(io, aligned, report.camera, mean_per_ms)
        after = seen.capture([hologram(aligned, target)], target, average=2)
        line["psnr_after_db"] = round(after.scores.psnr_db, 2)
        bench.stage.move_to({axis.name: 0.0 for axis in bench.stage.axes})
        before = replace(seen, display=known).capture([plain], target, average=2)
        line["psnr_before_db"] = round(before.scores.psnr_db, 2)
    still = dict.fromkeys(("z_um", "roll_mrad", "pitch_mrad", "yaw_mrad"), "0.0") | {"shift_um": "[0.0, 0.0]"}
    config = parse_config(configuration({**options, **still}, slm), None)
    with Bench(config).open() as bench:
        assert bench.slm is not None
        (world,) = bench.shared.values()
        assert isinstance(world, DisplayWorld)
        io = DisplayBench(bench, config.display.slm_binning)
        exact = replace(known, displacement=true_displacement(world, known.mask.shape)[::FINER, ::FINER])
        io.show(np.ones(known.slm_shape, complex))
        across = known.wavelength_nm * known.focal_mm / known.mask_pitch_um / bench.camera.pixel_pitch_um
        camera = register_camera(io.photograph(10.0), known, across)
        seen = HologramCamera(io, exact, camera, mean_per_ms)
        perfect = seen.capture([hologram(exact, target)], target, average=2)
        line["psnr_perfect_db"] = round(perfect.scores.psnr_db, 2)
    return line, plain


def main() -> None:
    """Run all starts, print and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--hard", action="store_true")
    parser.add_argument("--slm", default="360x640", help="pixels, HEIGHTxWIDTH")
    parser.add_argument("--no-pictures", action="store_true")
    parser.add_argument("--kind", choices=["all", *KINDS], default="all")
    parser.add_argument("--out", type=Path, default=Path("mask-alignment"))
    options = parser.parse_args()
    height, width = (int(n) for n in options.slm.split("x"))
    path = options.out.with_suffix(".csv")
    lines = read(path) if path.exists() else []
    done = {int(str(line["start"])) for line in lines}
    plain = None
    for seed in range(options.first, options.first + options.starts):
        if seed in done:
            continue
        hard = hardships(seed) if options.hard else {}
        line, plain = one_start(
            seed, options.kind, plain, hard, (height, width), pictures=not options.no_pictures
        )
        lines.append(line)
        print({k: v for k, v in line.items() if k not in draw(0)}, flush=True)
        write(path, lines)
    good = [line for line in lines if str(line["success"]) == "True"]
    print(f"SIMULATED: {len(good)} of {len(lines)} starts aligned")
    told = [str(line[name]) for line in good for name in line if name.startswith("pull_")]
    pulled = [abs(float(pull)) for pull in told if pull]
    if pulled:
        shares = ", ".join(f"{np.mean(np.array(pulled) <= sigma):.0%} within {sigma}" for sigma in (1, 2, 5))
        print(f"errors over stated uncertainties: {shares}, largest {max(pulled):.1f}")
    for name in (
        "frames",
        "residual_px",
        "efficiency",
        "predicted_lost_db",
        "psnr_before_db",
        "psnr_after_db",
        "psnr_perfect_db",
    ):
        values = np.array([line[name] for line in good if line.get(name)], float)
        if not len(values):
            continue
        print(f"{name}: median {np.median(values):.3f}, worst {values.min():.3f} to {values.max():.3f}")


def read(path: Path) -> list[dict[str, object]]:
    """Read what an earlier run wrote."""
    with path.open(newline="") as file:
        return [dict(line) for line in csv.DictReader(file)]


def write(path: Path, lines: list[dict[str, object]]) -> None:
    """Write one line a start."""
    names = list(dict.fromkeys(name for line in lines for name in line))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(lines)


if __name__ == "__main__":
    main()
