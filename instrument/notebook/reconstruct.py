"""From images, arrays or files to a result, in one call: what is prepared is what the terminal prepares."""

from __future__ import annotations

import inspect
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.bench.bench import Bench, open_bench
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import TEMPLATES, load_config, parse_config, template
from instrument.bench.source_and_scene import Ask
from instrument.files.calibration_file import is_calibration, load_calibration
from instrument.files.errors import BenchError
from instrument.files.images import ImageFile, read
from instrument.notebook.result import Result
from instrument.notebook.words import speaking
from instrument.reconstruction.job import Job, find_calibration, job_from_files, job_with
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.request import refocused, volume_job
from instrument.runs.run import Run
from instrument.runs.run_files import is_run
from recon.base.arguments import require_argument
from recon.base.checks import as_channels, plain_array
from recon.base.declare import options_of, require, require_known, with_overrides
from recon.errors import InputError
from recon.reconstruction import reconstruct as one_door
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Stage
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import Progress
from recon.types import Calibration

Image = Path | str | ImageFile | Measurement | npt.ArrayLike
Psf = Path | str | ImageFile | Calibration | npt.ArrayLike

_INPUTS = {f.name for f in fields(InputOptions)}
_FILES_ONLY = _INPUTS - set(one_door.FACTS)


@speaking
def calibration(folder: Path | str) -> Calibration:
    """Read a calibration: its folder, or the run that it was made in.

    Raises FileError when there is none, more than one, or it is damaged.
    """
    if not isinstance(folder, Path | str):
        raise BenchError(
            f"A calibration is read by its folder, not {type(folder).__name__}. PSFs in an array make one: "
            "db.Calibration(psfs, source_positions_um); a single one goes to db.reconstruct as it is."
        )
    return load_calibration(find_calibration(Path(folder)))


@speaking
def run(folder: Path | str) -> Run:
    """Open a run for reading, by its folder or that of the calibration in it.

    Raises RunError where there is none.
    """
    require_argument("folder", folder, Path)
    folder = Path(folder)
    return Run.open(folder.parent if is_calibration(folder) and is_run(folder.parent) else folder)


@speaking
def bench(config: BenchConfig | Path | str | None = None, *, ask: Ask | None = None) -> Bench:
    """Open a bench, to be used as a context manager.

    Parameters
    ----------
    config : path or str, optional
        A ``bench.toml``; or ``"display"``, ``"led_microscope"``, ``"screen"`` or ``"default"`` for one of the
        simulated benches. None: ``bench.toml`` in the working folder, else the simulated bench.
    ask : callable, optional
        Asks whoever stands at the bench to do something by hand.

    Raises
    ------
    ConfigError, FileError, DeviceError
        As :func:`~instrument.bench.bench.open_bench`.
    """
    return open_bench(bench_config(config), ask=ask)


def bench_config(config: BenchConfig | Path | str | None) -> BenchConfig:
    """Return the configuration that :func:`bench` opens."""
    if isinstance(config, BenchConfig):
        return config
    require_argument("bench", config, Path | None, f"Or one of the simulated ones: {', '.join(TEMPLATES)}.")
    if isinstance(config, str) and config in TEMPLATES and not Path(config).exists():
        return parse_config(template(config), None)
    return load_config(config)


@speaking
def reconstruct(
    image: Image,
    psf: Psf,
    options: ReconstructionOptions | None = None,
    *,
    warm: Reconstruction | None = None,
    on_progress: Progress | None = None,
    cancel: threading.Event | None = None,
    on_stage: Stage | None = None,
    **overrides: Any,
) -> Result:
    """Reconstruct a picture, or a volume where PSFs of several depths are given.

    Files, and images that were read from them, are prepared as the terminal does it: dark level, saturated
    pixels, raw colours, binning to half a megapixel; ``result.job.notes`` says what was done. Arrays are
    taken as they are, the PSF without background.

    Parameters
    ----------
    image : path, image, Measurement or array, (height, width) or (height, width, n_channels)
        The photograph.
    psf : path, image, Calibration or array
        A PSF image; a calibration's folder or a run with one; for a volume a folder or stack of PSFs, one a
        depth.
    options : ReconstructionOptions, optional
        How to reconstruct.
    warm, on_progress, cancel, on_stage
        As :func:`recon.reconstruct`. Without ``on_stage`` what takes over two seconds is told in a line.
    **overrides
        Single options by name: of the reconstruction (``prior="l1"``, ``iterations=50``, ``z_um=30e3``), and
        of how files are read (``dark``, ``crop``, ``binning``, ``erasures``, ``mosaic``, ``noise``), as
        values or in the words of the terminal (``dark="dark.tif"``, ``crop=(20, 30, 400, 600)``); ``dark``
        may be an image or array, too.

    Raises InputError, BenchError or FileError: what was found, what was expected, what to do.
    """
    image, psf = getattr(image, "measurement", image), getattr(psf, "calibration", psf)
    require_known(overrides, ReconstructionOptions, InputOptions)
    if not isinstance(warm, Reconstruction | None):
        raise BenchError(f"warm is a result to start from, not {type(warm).__name__}: warm=result.")
    if not isinstance(options, ReconstructionOptions | None):
        raise BenchError(
            f"options are db.Options(...), not {type(options).__name__}; single ones are given by name: "
            "prior='l1', warm=result."
        )
    require_hooks(on_progress, cancel)
    require_argument("on_stage", on_stage, Callable | None)
    told = on_stage or _Told()
    further: dict[str, Any] = {"warm": warm, "on_progress": on_progress, "cancel": cancel, "on_stage": told}
    try:
        if _is_file(image) or _is_file(psf):
            inputs = _inputs({name: overrides.pop(name) for name in _INPUTS & set(overrides)})
            options = with_overrides(options or ReconstructionOptions(), overrides)
            job = _job(_opened(image, "photograph"), psf, inputs, options)
            measurement = job.as_measurement(inputs.noise)
            return Result.of(one_door.reconstruct(measurement, job.calibration, options, **further), job)
        if about := sorted(_FILES_ONLY & set(overrides)):
            raise BenchError(
                f"{' and '.join(about)}: for files and images of db.read; arrays are taken as they are. "
                "Leave it out, and do it to the arrays yourself (a dark frame: photograph - dark)."
            )
        _require_one(image, psf)
        for name, given in (("photograph", image), ("PSF", psf)):
            _require_no_alpha(given, name)
        found = one_door.reconstruct(image, psf, options, **further, **overrides)  # type: ignore[arg-type]
        return Result.of(found, _job_of_arrays(image, psf))
    finally:
        if isinstance(told, _Told):
            told.end()


def require_hooks(on_progress: object, cancel: object) -> None:
    """Raise InputError where what tells of progress is no function, or what ends the work no event.

    An event is what has ``is_set``: one of processes, say.
    """
    require_argument("on_progress", on_progress, Callable | None)
    if isinstance(cancel, type) or not callable(getattr(cancel, "is_set", None)):
        require_argument("cancel", cancel, threading.Event | None, "threading.Event() makes one.")


def _require_one(image: Any, psf: Any) -> None:
    """Raise BenchError where an array has a photograph's size behind an axis that counts photographs."""
    shape, psf_shape = np.shape(image), np.shape(psf)
    if len(shape) == 3 and len(psf_shape) == 2 and shape[:2] != psf_shape == shape[1:]:
        raise BenchError(
            f"The photograph is an array {shape}: {shape[0]} of {shape[1]} x {shape[2]} pixels. Give one of "
            "them: photograph[0]; colours are the last axis: np.moveaxis(photograph, 0, -1)."
        )


def _require_no_alpha(given: Any, name: str) -> None:
    """Raise BenchError where the fourth channel of an array is the same everywhere, as transparency is."""
    if isinstance(given, Measurement | Calibration):
        return
    pixels = plain_array(given)
    if (
        pixels.ndim == 3
        and pixels.shape[-1] == 4
        and pixels.size
        and (fourth := pixels[..., 3]).min() == fourth.max()
    ):
        raise BenchError(
            f"The {name}'s fourth channel is {fourth[0, 0]:g} everywhere: transparency (RGBA), no light. "
            f"Give the colours alone: [..., :3]."
        )


def _is_file(given: object) -> bool:
    return isinstance(given, Path | str | ImageFile)


def _opened(given: Any, name: str) -> ImageFile:
    """Return an image of a file; an array as one, under a name for messages."""
    if isinstance(given, ImageFile):
        return given
    if isinstance(given, Path | str):
        return read(given)
    if isinstance(given, Measurement):
        raise BenchError(
            "A Measurement goes with a Calibration or an array, not with a file: db.read(...).pixels is one."
        )
    pixels = plain_array(given)
    if pixels.dtype.kind not in "uifb" or pixels.ndim < 2:
        raise BenchError(
            f"The {name} is a file, an image of db.read, or an array (height, width) of real numbers, "
            f"not {type(given).__name__}{f' {pixels.dtype} {pixels.shape}' if pixels.ndim else ''}."
        )
    if pixels.dtype not in (np.uint8, np.uint16):
        pixels = pixels.astype(np.float32)
    return ImageFile(Path(f"the {name}, an array"), pixels)


def _inputs(given: Mapping[str, Any]) -> InputOptions:
    """Return options of files; words are read as the terminal reads them, and numbers in a row as words."""
    declared = {o.name: o.declaration for o in options_of(InputOptions)}
    read: dict[str, Any] = {}
    for name, value in given.items():
        if isinstance(value, str) and value == declared[name].none_word:
            value = None
        if isinstance(value, tuple | list) and all(isinstance(one, Real) for one in value):
            value = ",".join(map(str, value))
        elif name == "dark" and np.ndim(value):
            opened = _opened(value, "dark frame")
            value = opened if value is opened else ImageFile(Path("an array"), opened.pixels)
        parse = declared[name].parse if isinstance(value, str) else None
        try:
            read[name] = value if parse is None else parse(value)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    inputs = InputOptions(**read)
    require(inputs)
    return inputs


def _job(image: ImageFile, psf: Any, inputs: InputOptions, options: ReconstructionOptions) -> Job:
    """Bring a photograph and PSFs together."""
    if isinstance(psf, Calibration):
        job = job_with(psf, Path("the calibration"), image, inputs)
    elif isinstance(psf, Path | str) and Path(psf).is_dir():
        job = volume_job(Path(psf), image, inputs)
    else:
        file = _opened(psf, "PSF")
        job = volume_job(file, image, inputs) if file.is_stack else job_from_files(file, image, inputs)
    z_um, beside = options.z_um, options.refine_psf
    return job if z_um is None else refocused(job, z_um, beside=beside)


def _job_of_arrays(image: Any, psf: Any) -> Job:
    """Return what arrays were reconstructed from."""
    pixels = plain_array(image.image if isinstance(image, Measurement) else image).astype(
        np.float32, copy=False
    )
    if not isinstance(psf, Calibration):
        psf = Calibration(as_channels(psf, "PSF")[None], np.full((1, 3), np.nan))
    simulated = bool(psf.provenance.get("simulated"))
    return Job(pixels, psf, {}, provenance={"image": {"path": "an array"}}, simulated=simulated)


class _Told:
    """Tells on one line of a terminal or notebook how far a job is, from its second second on."""

    PATIENCE_S, EVERY_S = 2.0, 0.5

    def __init__(self) -> None:
        self._began_s = self._said_s = time.monotonic()
        self._is_watched = sys.stderr.isatty() or "ipykernel" in sys.modules
        self._has_spoken = False

    def __call__(self, share: float, what: str) -> None:
        now_s = time.monotonic()
        took_s = now_s - self._began_s
        if not self._is_watched or took_s < self.PATIENCE_S or now_s - self._said_s < self.EVERY_S:
            return
        self._said_s, self._has_spoken = now_s, True
        left = f", {took_s * (1 - share) / share:.0f} s left" if share > 0 else ""
        sys.stderr.write(f"\r{share:4.0%} {what}{left}".ljust(79))

    def end(self) -> None:
        """Clear the line."""
        if self._has_spoken:
            sys.stderr.write("\r" + " " * 79 + "\r")


def _signature() -> inspect.Signature:
    """Return the signature with every option by name: what a notebook completes."""
    own = [p for p in inspect.signature(reconstruct).parameters.values() if p.kind is not p.VAR_KEYWORD]
    known = {p.name for p in own}
    declared = {o.name: o for o in (*options_of(ReconstructionOptions), *options_of(InputOptions))}
    named = [
        inspect.Parameter(o.name, inspect.Parameter.KEYWORD_ONLY, default=o.default, annotation=o.type)
        for o in declared.values()
        if o.name not in known
    ]
    return inspect.Signature([*own, *named], return_annotation=Result)


reconstruct.__signature__ = _signature()  # type: ignore[attr-defined]
