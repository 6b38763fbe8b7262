"""The one place where the golden set touches the project: thin functions that return plain results.

When the project's interface changes, this file changes and the cases do not. Each function returns a mapping
of arrays, numbers and words.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import recon
from recon.arrays import Array
from recon.base import threads
from recon.holography import (
    DcTerm,
    Display,
    HologramModel,
    Target,
    compute_hologram,
    foveal_weights,
    judge,
    random_mask,
)
from tests.device import played

Result = dict[str, Any]
Calibration = Mapping[str, Any]


@contextmanager
def threads_used(count: int) -> Iterator[None]:
    """Compute with so many threads."""
    before = threads.get_threads()
    threads.set_threads(count)
    try:
        yield
    finally:
        threads.set_threads(before)


def _calibration(given: Calibration | Array) -> Any:
    if isinstance(given, np.ndarray):
        return given
    geometry = recon.Geometry(given["pitch_um"], given["distance_mm"])
    return recon.Calibration(given["psfs"], given["positions_um"], geometry=geometry)


def noise_model(read_noise: float, counts_per_electron: float) -> Any:
    """Return what the project takes as a camera's noise."""
    return recon.NoiseModel(read_noise, counts_per_electron)


def wishes(**wanted: str) -> Any:
    """Return choices that are not left to the program, from words."""
    from recon.reconstruction.options import Overrides

    return Overrides.parse(wanted)


def picture(measurement: Array, calibration: Calibration | Array, **options: Any) -> Result:
    """Reconstruct a picture of one depth."""
    return _of_picture(recon.reconstruct(measurement, _calibration(calibration), **_iterated(options)))


def volume(measurement: Array, calibration: Calibration, **options: Any) -> Result:
    """Reconstruct a volume."""
    return _of_volume(recon.reconstruct(measurement, _calibration(calibration), **_iterated(options)))


def picture_on_device(measurement: Array, psf: Array, **options: Any) -> Result:
    """Reconstruct a picture as on a GPU, its array library played by NumPy."""
    with played():
        return picture(measurement, psf, device="gpu", **options)


def volume_on_device(measurement: Array, calibration: Calibration, **options: Any) -> Result:
    """Reconstruct a volume as on a GPU, its array library played by NumPy."""
    with played():
        return volume(measurement, calibration, device="gpu", **options)


def started_picture(first: Array, second: Array, psf: Array, **options: Any) -> Result:
    """Reconstruct a picture from where that of another measurement ended."""
    cold = recon.reconstruct(first, psf, **_iterated(options))
    return picture(second, psf, warm=cold, **options)


def started_volume(first: Array, second: Array, calibration: Calibration, **options: Any) -> Result:
    """Reconstruct a volume from where that of another measurement ended."""
    cold = recon.reconstruct(first, _calibration(calibration), **_iterated(options))
    return volume(second, calibration, warm=cold, **options)


def resumed(
    kind: str, measurement: Array, calibration: Any, *, after: int, iterations: int, **options: Any
) -> Result:
    """Keep a reconstruction in a folder after some iterations, and go on with it."""
    from instrument.reconstruction.checkpointing import CheckpointFolder

    run = {"picture": picture, "volume": volume}[kind]
    with TemporaryDirectory() as folder:
        for count in (after, iterations):
            keeper = CheckpointFolder(Path(folder) / "kept", {"what": kind})
            found = run(measurement, calibration, iterations=count, keeper=keeper, **options)
        found["resumed from"] = keeper.resumed_from
    return found


def scratch_volume(
    measurement: Array, calibration: Calibration, *, memory_gib: float, **options: Any
) -> Result:
    """Reconstruct a volume with a memory limit, the rest in files."""
    with TemporaryDirectory() as folder:
        found = recon.reconstruct(
            measurement,
            _calibration(calibration),
            memory_gib=memory_gib,
            scratch=folder,
            **_iterated(options),
        )
    return {**_of_volume(found), "files": str(found.provenance["memory"])}


def patterned(frames: Array, light: Array, psf: Array, **options: Any) -> Result:
    """Reconstruct one picture from frames under patterns of light."""
    measurement = recon.Measurement(frames, patterns=light)
    return _of_picture(recon.reconstruct(measurement, psf, tolerance=2e-4, **options))


def video(frames: Array, psf: Array, *, cold: int, warm: int, **options: Any) -> Result:
    """Reconstruct frames one after the other, each from where the one before ended; begin anew half way."""
    from recon.streams.video import VideoSolver, stream_problem

    solver = VideoSolver(
        stream_problem(frames[0], psf, **options), cold_iterations=cold, warm_iterations=warm
    )
    pictures = []
    for n, frame in enumerate(frames):
        if n == len(frames) // 2:
            solver.begin()
        pictures.append(solver.next(frame))
    return {"image": np.stack(pictures), "weight": solver.weights[0]}


def joint(frames: Array, psf: Array, over_time: Any, **options: Any) -> Result:
    """Reconstruct frames together, with a prior over time."""
    from recon.streams.joint import solve_together
    from recon.streams.video import stream_problem

    return {"image": solve_together(stream_problem(frames[0], psf), frames, over_time, **options)}


def live(frames: Sequence[Array], psf: Array, *, refinements: int, **options: Any) -> Result:
    """Feed frames as a running camera does, and refine each so many times by one iteration.

    Iterations are counted, not timed: the budget leaves room for one iteration a frame at most.
    """
    from recon.streams.live import LiveReconstructor

    reconstructor = LiveReconstructor(psf, budget_ms=1e-3, coarsest=1, **options)
    pictures, said, done = [], [], []
    for frame in frames:
        found = reconstructor.feed(frame)
        pictures.append(found.image)
        said.append(f"{found.method} {found.scene}")
        for _ in range(refinements):
            refined = reconstructor.refine()
            assert refined is not None
        pictures.append(refined.image)
        done.append(refined.total_iterations)
    return {"image": np.stack(pictures), "said": "; ".join(said), "iterations": str(done)}


def from_files(images: Mapping[str, Array], *arguments: str) -> Result:
    """Reconstruct through the command line from image files (``image``, and ``psf`` or ``volume``)."""
    import tifffile

    from instrument.files.images import read_image

    with TemporaryDirectory() as folder:
        paths = {name: Path(folder) / f"{name}.tif" for name in images}
        for name, pixels in images.items():
            tifffile.imwrite(paths[name], pixels)
        out = Path(folder) / "out.tif"
        given = [word for name, path in paths.items() for word in (f"--{name}", str(path))]
        code, said = command("reconstruct", *given, *arguments, "--out", str(out))
        assert code == 0, said
        return {"image": read_image(out).pixels}


def command(*words: str) -> tuple[int, str]:
    """Run a command line in this process; return its exit status and what it said."""
    from instrument.cli import main

    said = StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        code = main(list(words))
    return code, said.getvalue()


def command_names() -> list[tuple[str, ...]]:
    """Return every command and subcommand."""
    import typer

    from instrument.cli import COMMANDS

    found: list[tuple[str, ...]] = [()]
    for name, entry in COMMANDS.items():
        found.append((name,))
        parsed = typer.main.get_command(entry.load())
        found += [(name, inner) for inner in sorted(getattr(parsed, "commands", {}))]
    return found


def hologram(  # noqa: PLR0913 - what the cases vary
    targets: Sequence[tuple[Array, float]],
    slm: tuple[int, int],
    *,
    pixels: int = 2,
    loss: str = "frequency",
    frames: int = 1,
    grid: Any = "alias-free",
    dc: tuple[float, float] | None = None,
    mask_fill: float = 0.0,
    bent: float = 0.0,
    precise: bool = False,
    iterations: int = 15,
    **options: Any,
) -> Result:
    """Compute the SLM's phases that show pictures (image, distance) through a random mask."""
    displacement = bent * np.indices((5, 7)).transpose(1, 2, 0) / 6 if bent else None
    display = Display(
        slm,
        random_mask((slm[0] * pixels, slm[1] * pixels), seed=1),
        dc=DcTerm(*(dc or (0.0, 0.0))),
        mask_fill=mask_fill,
        displacement=displacement,
    )
    shown = [Target(image, z_mm) for image, z_mm in targets]
    complex_slm = bool(options.pop("complex_slm", False))
    weights = foveal_weights((64, 64), radius=0.3, periphery=0.05) if loss == "spatial" else None
    model = HologramModel(
        display,
        shown,
        loss=loss,
        weights=weights,
        grid=grid,
        frames=frames,
        complex_slm=complex_slm,
        dtype=np.complex128 if precise else np.complex64,
    )
    found = compute_hologram(model, iterations=iterations, tolerance=0, **options)
    seen = np.stack([model.seen(found.slm, plane) for plane in range(len(shown))])
    # The judge knows no displacement: it says what is shown where the mask lies as it should.
    scores = judge(found.slm, replace(display, displacement=None), shown[0])
    return {
        "slm": np.stack([found.slm.real, found.slm.imag]),
        "seen": np.asarray(seen, np.float32),
        "iterations": found.history[-1].iteration,
        "stopped": found.stop_reason.name,
        "loss": found.history[-1].loss,
        "psnr_db": found.history[-1].psnr_db,
        "judged_db": scores.psnr_db,
    }


def chart(family: Any, size: int, settings: Sequence[Mapping[str, Any]], counts: Sequence[int]) -> Result:
    """Score settings of a reconstruction at counts of iterations; times are left out."""
    from recon.evaluation.chart_reconstruction import ChartProblem
    from recon.evaluation.scene import make_scene
    from recon.evaluation.trial import Setting

    scene = make_scene(family, size=size)
    problem = ChartProblem.of_scene(scene)
    scores = []
    for setting in settings:
        curve = problem.run(Setting(**setting), counts=counts)
        scores += [(p.iterations, p.psnr_db, p.ssim, p.nrmse, p.residual, p.held_out) for p in curve.points]
    return {"scores": np.array(scores), "settings": "\n".join(sorted(s.name for s in problem.settings()))}


def stability_map(name: str, methods: Sequence[str]) -> Result:
    """Make a map of where methods fail; times are left out."""
    from recon.evaluation.maps import map_named, run_map

    cells = [c.as_json() for c in run_map(map_named(name), "quick", methods=list(methods))]
    cells.sort(key=lambda c: (c["method"], c["ix"], c["iy"]))
    return {
        "errors": np.array([c["error"] for c in cells], float),
        "severities": np.array([c["severity"] for c in cells], float),
        "failures": "; ".join(f"{c['method']} {c['ix']} {c['iy']}: {c['failure']}" for c in cells),
    }


def project_file() -> Path:
    """Return a file of the project, to tell which tree is being tested."""
    return Path(sys.modules["recon"].__file__ or "")


# Results --------------------------------------------------------------------------------------------
def _iterated(options: Mapping[str, Any]) -> dict[str, Any]:
    """By default nothing ends a run but its count of iterations."""
    found = {"tolerance": 0.0, **options}
    if options.get("method") == "wiener" or found["tolerance"] is None:
        del found["tolerance"]
    renamed = {"method": "solver", "wishes": "choose"}
    return {renamed.get(name, name): value for name, value in found.items()}


def _of_picture(found: recon.Reconstruction) -> Result:
    last = found.history[-1] if found.history else None
    result: Result = {
        "image": found.image,
        "model": ""
        if found.choice is None
        else "; ".join(f"{d.name} {d.value}" for d in found.choice.decisions),
        "iterations": len(found.history),
        "stopped": found.stop_reason.name,
        "verdict": "" if found.verdict is None else str(found.verdict.region),
        "tau": found.tau,
        "noise_norm": found.noise_norm,
    }
    if last is not None:
        result |= {"objective": last.objective, "residual": last.data_residual}
    return _known(result)


def _of_volume(found: recon.Reconstruction) -> Result:
    lasts = [history[-1] for history in found.histories]
    decided = "" if found.choice is None else "; ".join(f"{d.name} {d.value}" for d in found.choice.decisions)
    result: Result = {
        "image": found.volume,
        "model": f"{found.model}: {decided}" if decided else found.model,
        "iterations": " ".join(str(len(history)) for history in found.histories),
        "stopped": " ".join(reason.name for reason in found.stop_reasons),
        "verdict": "" if found.verdict is None else str(found.verdict.region),
        "tau": found.tau,
        "noise_norm": found.noise_norm,
        "objective": float(np.sum([r.objective for r in lasts])),
        "residual": float(np.sum([r.data_residual for r in lasts])),
        "empty planes": str([list(e.planes) for e in found.empty_planes]) if found.empty_planes else "",
    }
    if found.background is not None:
        result["background"] = found.background
    return _known(result)


def _known(result: Result) -> Result:
    """Leave out what a method does not tell."""
    return {k: v for k, v in result.items() if v is not None and not (isinstance(v, float) and np.isnan(v))}
