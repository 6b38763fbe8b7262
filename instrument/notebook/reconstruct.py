"""From images, arrays or files to a result, in one call: what is prepared is what the terminal prepares."""

from __future__ import annotations

import inspect
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from instrument.bench.bench import Bench, open_bench
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import TEMPLATES, load_config, parse_config, template
from instrument.bench.source_and_scene import Ask
from instrument.files.calibration_file import find_calibration, is_calibration, load_calibration
from instrument.files.errors import BenchError
from instrument.notebook.asked import FACTS, Asked, Image, Psf, recording_of
from instrument.notebook.of_runs import PATTERNED, forecast_of_run
from instrument.notebook.result import Result
from instrument.notebook.words import speaking
from instrument.reconstruction import forecast as by_its_beginning
from instrument.reconstruction.forecast import Forecast
from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.runs.run import Run
from instrument.runs.run_files import is_run
from recon.base.arguments import require_argument
from recon.base.declare import options_of
from recon.reconstruction import reconstruct as one_door
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Stage
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import Progress
from recon.types import Calibration


@speaking
def calibration(folder: Path | str) -> Calibration:
    """Read a calibration: its ``folder``, or the run that it was made in.

    Returns
    -------
    Calibration
        PSFs float32, (n_places, n_channels, height, width), and where they were taken, micrometres.

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
    """Open a run for reading, by its ``folder`` or that of the calibration in it.

    Returns
    -------
    Run
        Frames and what is known of each are read as they are asked for: ``images(label)``, ``metadata(n)``.

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

    Returns
    -------
    Bench
        Its devices open; they are closed, light off and motion stopped, at the end of ``with``.

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
        may be an image or array, too. And what is known of the light: ``vignetting``, relative light on the
        photograph's own pixels (a file, image or array) that it is divided by; of arrays also ``background``,
        ``patterns`` and ``lines``, as :class:`~recon.reconstruction.measurement.Measurement` has them.

    Returns
    -------
    Result
        ``volume`` float32, (n_z, height, width[, n_channels]), and of a picture ``image``, its one plane; in
        the units in which PSFs and volume make the measurement. It shows and saves itself.

    Raises InputError, BenchError or FileError: what was found, what was expected, what to do.
    """
    if not isinstance(warm, Reconstruction | None):
        raise BenchError(f"warm is a result to start from, not {type(warm).__name__}: warm=result.")
    require_hooks(on_progress, cancel)
    with _telling(on_stage) as told:
        asked = Asked.of(image, psf, options, overrides)
        found = one_door.reconstruct(
            asked.measurement,
            asked.calibration,
            asked.options,
            warm=warm,
            on_progress=on_progress,
            cancel=cancel,
            on_stage=told,
        )
        return Result.of(found, asked.job)


@speaking
def forecast(
    image: Image | Run,
    psf: Psf,
    options: ReconstructionOptions | None = None,
    *,
    on_stage: Stage | None = None,
    **overrides: Any,
) -> Forecast:
    """Say what time and memory a reconstruction will take here, as busy as this machine is now.

    Its first iterations are carried out, all of it where that takes a few seconds: the same that
    ``diffuserbench reconstruct --explain`` tells.

    Parameters
    ----------
    image, psf, options, on_stage, **overrides
        As :func:`reconstruct`, whose errors it raises. A recording (:func:`run`, or its folder) with a PSF's
        file or a calibration's folder stands for its film, with the film's options by name (``block``,
        ``workers`` ...); with ``patterned``, a sheet's run or its patterns as ``.npy``, for the picture of a
        run in patterned light. Of both all that ``diffuserbench reconstruct RUN`` would do is told.

    Returns
    -------
    Forecast
        Seconds, and bytes at the peak beyond what the program takes.
    """
    with _telling(on_stage) as told:
        if (run_of_frames := recording_of(image)) is not None:
            return forecast_of_run(run_of_frames, psf, options, overrides, told)
        shared = {o.name for kind in (ReconstructionOptions, InputOptions) for o in options_of(kind)}
        of_runs = {o.name for o in options_of(VideoOptions)} - shared | {PATTERNED}
        if about := sorted(of_runs & set(overrides)):
            raise BenchError(f"{' and '.join(about)}: for a recording, not for a photograph. Leave it out.")
        asked = Asked.of(image, psf, options, overrides)
        return by_its_beginning.forecast(asked.measurement, asked.calibration, asked.options, told)


def require_hooks(on_progress: object, cancel: object) -> None:
    """Raise InputError where what tells of progress is no function, or what ends the work no event.

    An event is what has ``is_set``: one of processes, say.
    """
    require_argument("on_progress", on_progress, Callable | None)
    if isinstance(cancel, type) or not callable(getattr(cancel, "is_set", None)):
        require_argument("cancel", cancel, threading.Event | None, "threading.Event() makes one.")


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


@contextmanager
def _telling(on_stage: Stage | None) -> Iterator[Stage]:
    """Give what is told how far a job is: the function that was given, else a line."""
    require_argument("on_stage", on_stage, Callable | None)
    told = _Told()
    try:
        yield on_stage or told
    finally:
        told.end()


def _with_options(
    function: Callable[..., Any], returned: type, *further: type, facts: Sequence[str] = ()
) -> inspect.Signature:
    """Return the signature with every option by name: what a notebook completes."""
    own = [p for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD]
    known = {p.name for p in own}
    kinds = (ReconstructionOptions, InputOptions, *further)
    declared = {o.name: o for kind in kinds for o in options_of(kind)}
    named = [
        inspect.Parameter(o.name, inspect.Parameter.KEYWORD_ONLY, default=o.default, annotation=o.type)
        for o in declared.values()
        if o.name not in known
    ]
    named += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Any)
        for name in facts
    ]
    return inspect.Signature([*own, *named], return_annotation=returned)


reconstruct.__signature__ = _with_options(reconstruct, Result, facts=FACTS)  # type: ignore[attr-defined]
forecast.__signature__ = _with_options(  # type: ignore[attr-defined]
    forecast, Forecast, VideoOptions, facts=(*FACTS, PATTERNED)
)
