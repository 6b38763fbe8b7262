"""What a recording's film, or a run in patterned light, is asked for in Python: what it will take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from instrument.files.calibration_file import is_calibration
from instrument.files.errors import BenchError
from instrument.notebook.asked import inputs_of
from instrument.reconstruction.forecast import Forecast
from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.reconstruction.patterned import PatternedRequest, forecast_patterned, prepare_patterned
from instrument.reconstruction.video import VideoRequest
from instrument.reconstruction.video_forecast import forecast_video, trial_of
from instrument.runs.run import Run
from instrument.runs.run_files import is_run
from recon.base.declare import options_of, require_known, with_overrides
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Stage

_OF_RUNS = (ReconstructionOptions, InputOptions, VideoOptions)
PATTERNED = "patterned"
"""Names the sheet of a run in patterned light, as ``--patterned`` does."""


def forecast_of_run(
    run: Run,
    psf: Any,
    options: ReconstructionOptions | None,
    overrides: Mapping[str, Any],
    on_stage: Stage,
) -> Forecast:
    """Say what a recording's film takes, or with ``patterned=SHEET`` the picture of a run in patterned light.

    Nothing of it is left. Errors as of :func:`~instrument.reconstruction.video.prepare_video` and
    :func:`~instrument.reconstruction.patterned.prepare_patterned`.
    """
    sheet, given = overrides.get(PATTERNED), {n: v for n, v in overrides.items() if n != PATTERNED}
    subject = "video" if sheet is None else "patterned picture"
    require_known(given, *_OF_RUNS)
    _require_of(subject, given)
    place = _place(psf)
    inputs = inputs_of(_of(InputOptions, given))
    asked = with_overrides(options or ReconstructionOptions(), _of(ReconstructionOptions, given))
    if sheet is not None:
        if not isinstance(sheet, Path | str):
            raise BenchError(f"{PATTERNED} is the sheet's run or a .npy file, not {type(sheet).__name__}.")
        request = PatternedRequest(
            run=run.path, sheet=Path(sheet), calibration=place, inputs=inputs, options=asked
        )
        prepared = prepare_patterned(request, _shared(on_stage, "patterns"))
        return forecast_patterned(prepared, lambda share, what: on_stage((1 + share) / 2, what))
    calibrated = place.is_dir() and (is_calibration(place) or is_run(place))
    with TemporaryDirectory() as folder:
        film = VideoRequest(
            run=run.path,
            out=Path(folder) / "film.ome.zarr",
            psf=None if calibrated else place,
            calibration=place if calibrated else None,
            inputs=inputs,
            options=asked,
            video=VideoOptions(**_of(VideoOptions, given)),
        )
        with trial_of(film) as trial:
            told = forecast_video(trial, on_progress=lambda share: on_stage(share, "the first frames"))
    assert told is not None  # nothing cancels it
    return told


def _place(psf: Any) -> Path:
    """Return where PSFs lie: of films and patterned light they are files, which workers read too."""
    if isinstance(psf, Path | str):
        return Path(psf)
    raise BenchError(
        f"A run's PSF is given by its file, or by its calibration's folder, not {type(psf).__name__}: "
        "db.write_image writes an array, db.save_calibration a calibration."
    )


def _of(options: type, given: Mapping[str, Any]) -> dict[str, Any]:
    names = {field.name for field in fields(options)}
    return {name: value for name, value in given.items() if name in names}


def _require_of(subject: str, given: Mapping[str, Any]) -> None:
    """Raise BenchError for an option that does not apply, which the terminal refuses as well."""
    declared = {o.name: o.declaration for options in _OF_RUNS for o in options_of(options)}
    of_films = {field.name for field in fields(VideoOptions)}
    for name in given:
        applies = ("video",) if name in of_films else declared[name].applies
        if applies and subject not in applies:
            raise BenchError(f"{name}: for a {' or '.join(applies)}, not for a {subject}. Leave it out.")


def _shared(on_stage: Stage, what: str) -> Callable[[int, int], object]:
    """Tell how many are done as a share of half of all."""
    return lambda done, total: on_stage(done / max(total, 1) / 2, what)
