"""``diffuserbench test``: whether this installation works on this machine, part by part."""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import chdir
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from drivers.errors import DeviceError
from instrument.cli.app import App, examples
from instrument.cli.progress import one_task
from instrument.files.errors import BenchError
from recon.errors import InputError

if TYPE_CHECKING:
    from recon.evaluation.scene import TestScene

app = App()

ADJOINT = 1e-4
"""Largest relative difference of <Ax, y> and <x, A^H y> in float32 over a picture's pixels."""
LEAST_DB = 15.0
"""PSNR that every solver reaches on the scene of points; the worst, a Wiener filter, has 19 dB."""

_BENCH = """
camera.driver = "simulated"
stage.driver = "simulated"
led_array.driver = "simulated"
source.rgb = [0, 255, 0]
scene.control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
scene = "bars"
scene_rgb = [0, 1, 0]
"""


class BrokenError(Exception):
    """What does not work, in a sentence."""


def packages(_folder: Path) -> str:
    """Look whether all that the program needs is installed, and say which extras are."""
    extras: dict[str, bool] = {}
    for line in metadata.requires("diffuserbench") or ():
        needed, _, condition = line.partition(";")
        name = re.split(r"[^A-Za-z0-9_.-]", needed.strip(), maxsplit=1)[0]
        there = _is_installed(name)
        extra = re.search(r"extra == ['\"]([^'\"]+)", condition)
        if extra is None and not there:
            raise BrokenError(f"{name} is not installed: install diffuserbench again, by pip.")
        if extra is not None and not extra[1].startswith(("dev", "docs", "test")):
            extras[extra[1]] = there and extras.get(extra[1], True)
    having = ", ".join(sorted(name for name, there in extras.items() if there)) or "none"
    lacking = ", ".join(sorted(name for name, there in extras.items() if not there)) or "none"
    return f"extras installed: {having}; not installed: {lacking}"


def _is_installed(distribution: str) -> bool:
    try:
        metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


def _scene(**about: Any) -> TestScene:
    from recon.evaluation.scene import make_scene

    return make_scene("sparse-picture", size=48, **about)


def cameras(_folder: Path) -> str:
    """Look whether every camera model's adjoint belongs to it: <Ax, y> = <x, A^H y>."""
    from recon.base.declare import with_overrides
    from recon.camera.camera_model import model_names
    from recon.reconstruction.options import Options
    from recon.reconstruction.part import Part
    from recon.reconstruction.problem import Problem

    scene, random, worst = _scene(grid=3), np.random.default_rng(0), 0.0
    tried = [name for name in model_names() if name != "auto"]
    for model in tried:
        options = with_overrides(Options(), {"model": model})
        problem = Problem.of(scene.measurement, scene.calibration, options)
        part = Part(problem, slice(0, 1))
        A = part.operator
        x = random.normal(size=A.domain_shape).astype(A.dtype)
        y = random.normal(size=A.range_shape).astype(A.dtype)
        one, other = float(np.vdot(A(x), y)), float(np.vdot(x, A.H(y)))
        part.close()
        apart = abs(one - other) / (np.linalg.norm(A(x)) * np.linalg.norm(y))
        if not apart < ADJOINT:
            raise BrokenError(f"{model}: <Ax, y> is {one:.6g}, <x, A^H y> {other:.6g}.")
        worst = max(worst, float(apart))
    return f"{', '.join(tried)}: to {worst:.0e}"


def priors(_folder: Path) -> str:
    """Look whether every prior's prox is a minimiser: nothing near it is better."""
    from recon.priors import PRIORS

    random = np.random.default_rng(0)
    v = random.normal(size=(1, 1, 12, 12)).astype(np.float32)
    for name, named in PRIORS.items():
        prior = named(0.3)

        def cost(x: Any, prior: Any = prior) -> float:
            return float(prior.value(x)) + float(np.sum((x - v) ** 2)) / 2

        if not named.exact:
            continue
        found = prior.prox(v, 1.0)
        directions = [v - found, found, *random.normal(size=(4, *v.shape)).astype(np.float32)]
        for near in (found + step * way for way in directions for step in (-0.1, -0.01, 0.01, 0.1)):
            near = np.maximum(near, 0) if found.min() >= 0 else near
            if cost(near) < cost(found) - 1e-3:
                raise BrokenError(f"{name}: the prox costs {cost(found):.6g}, what is near {cost(near):.6g}.")
    return ", ".join(PRIORS)


def solvers(_folder: Path) -> str:
    """Look whether every solver finds a scene whose truth is known."""
    from recon import reconstruct
    from recon.base.metrics import psnr
    from recon.reconstruction.solvers import SOLVERS

    scene, found, left_out = _scene(), {}, []
    for name in SOLVERS:
        try:
            picture = reconstruct(scene.measurement, scene.calibration, solver=name, noise=scene.noise)
        except InputError:
            left_out.append(name)  # for volumes, or in need of what is not here
            continue
        found[name] = psnr(picture.image, scene.truth)
        if not found[name] > LEAST_DB:
            raise BrokenError(f"{name}: {found[name]:.1f} dB from the truth; {LEAST_DB:g} and more expected.")
    if not found:
        raise BrokenError(f"every solver refuses a picture: {', '.join(left_out)}.")
    said = ", ".join(f"{name} {db:.1f} dB" for name, db in found.items())
    return f"{said}; not tried on a picture: {', '.join(left_out)}" if left_out else said


def files(folder: Path) -> str:
    """Look whether what is written is read again, to the last bit."""
    from instrument.files.images import WRITABLE, read, write_image

    random = np.random.default_rng(0)
    kept = 0
    for suffix in WRITABLE:
        for dtype in (np.uint8, np.uint16, np.float32):
            for shape in ((9, 7), (9, 7, 3)):
                if suffix == ".png" and dtype is np.float32:
                    continue
                image = (random.random(shape) * 200).astype(dtype)
                path = folder / f"{np.dtype(dtype).name}-{len(shape)}{suffix}"
                write_image(path, image)
                if not np.array_equal(read(path).pixels, image):
                    raise BrokenError(f"{path.name} is not read as it was written.")
                kept += 1
    return f"{kept} kinds of images"


def bench(folder: Path) -> str:
    """Calibrate the simulated bench, take a photograph, look whether every frame is on the disk."""
    from calibration_routines.optics.photograph import photograph
    from calibration_routines.psf.sweep import calibrate_sweep
    from calibration_routines.psf.sweep_options import AxialSweep
    from instrument.bench.bench import open_bench
    from instrument.bench.config_file import parse_config
    from instrument.runs.run import Run
    from recon import reconstruct

    with chdir(folder), open_bench(parse_config(_BENCH, folder / "bench.toml")) as opened:
        opened.camera.set_binning(2)
        assert opened.stage is not None
        opened.stage.home()
        sweep = calibrate_sweep(opened, AxialSweep(z_min_um=90e3, average=2))
        photo = photograph(opened, average=2)
        if sweep.findings:
            raise BrokenError(f"the calibration of the simulated bench: {sweep.findings[0]}")
        frames = 0
        for path in (sweep.path.parent, photo.run.path):
            run = Run.open(path)
            if run.damaged() or run.missing():
                raise BrokenError(f"{run.path.name}: frames are missing or damaged; is the disk sound?")
            frames += run.n_frames
    picture = reconstruct(photo.measurement, sweep.calibration, iterations=20)
    if not np.isfinite(picture.image).all():
        raise BrokenError("the reconstruction is not finite.")
    return f"{frames} frames taken and read again, SIMULATED"


PARTS: Mapping[str, Callable[[Path], str]] = {
    part.__name__: part for part in (packages, files, cameras, priors, solvers, bench)
}


@app.command(
    name="test",
    epilog=examples(
        "diffuserbench test", "diffuserbench test files bench", "diffuserbench --debug test cameras"
    ),
)
def selftest(
    parts: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PART]...", help=f"{', '.join(PARTS)}; default all.", show_default=False),
    ] = None,
) -> None:
    """Test this installation: packages, files, camera models, priors, solvers, the simulated bench.

    Ten seconds; the first time half a minute of compiling. What it writes goes into a temporary folder.
    A bench of real devices is tested by diffuserbench check --thorough. Ends with status 1 when something
    does not work.
    """
    if unknown := [part for part in parts or () if part not in PARTS]:
        raise BenchError(f"There is no part {unknown[0]!r} to test. Parts: {', '.join(PARTS)}.")
    typer.echo(
        f"diffuserbench {metadata.version('diffuserbench')}, Python {_python()}, {os.cpu_count()} processors"
    )
    typer.echo("About ten seconds; the first time half a minute, for compiling.", err=True)
    broken = []
    for name in parts or PARTS:
        began_s = time.monotonic()
        with tempfile.TemporaryDirectory() as folder, one_task(f"Testing {name}"):
            try:
                said = PARTS[name](Path(folder))
            except (BrokenError, BenchError, DeviceError, InputError, OSError) as error:
                broken.append(name)
                said = f"BROKEN: {error}"
            except Exception as error:  # noqa: BLE001 - a broken package fails in its own ways
                broken.append(name)
                said = f"BROKEN: {type(error).__name__}: {error}"
        typer.echo(f"{name:<10}{time.monotonic() - began_s:5.1f} s  {said}")
    if broken:
        typer.echo(f"Does not work: {', '.join(broken)}.", err=True)
        raise typer.Exit(1)
    typer.echo("All of it works.")


def _python() -> str:
    import platform

    return f"{platform.python_version()} on {platform.machine()}"
