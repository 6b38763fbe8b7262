"""A film as people look at it: a recording or a reconstructed video; curves of regions; exports."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import require_new, whole_file, write_text
from instrument.files.errors import FileError, ranges
from instrument.files.films import as_shown, write_mp4
from instrument.files.ome_zarr import is_zarr_name
from instrument.files.orientation import AS_IT_IS, Kind, Orientation
from instrument.files.reading import MOST_TEXT_BYTES, require_file
from instrument.reconstruction.video_files import (
    DEFAULT_FPS,
    VideoPictures,
    create_output,
    levels_of,
    require_video,
    samples_of,
)
from instrument.runs.export import export
from instrument.runs.run import Run
from instrument.volumes.writing import write_film_tiff
from recon.arrays import Array, Float64Array

if TYPE_CHECKING:
    from recon.camera.grid import Grid

Window = tuple[slice, slice]
"""Rows and columns."""
Advance = Callable[[int, int], object]
TIFF_SUFFIXES = (".tif", ".tiff")
FILM_SUFFIXES = (".mp4", ".gif", ".ome.zarr", *TIFF_SUFFIXES, ".csv")
BASELINE_PERCENTILE = 20.0
_GIF_MS = 10
"""What a GIF's times are told in."""
_GIF_FASTEST_MS = 2 * _GIF_MS
"""Shown faster by no browser."""
_GIF_BYTES = 2**30
"""All pictures of a GIF are in memory, a byte a pixel, before the first is written."""


class Film:
    """The pictures of a recording, or of a video that was reconstructed from one.

    Parameters
    ----------
    path : Path
        A run, or the ``.ome.zarr`` of ``reconstruct --video`` or ``activity``.

    Raises FileError where it is neither, or has no picture.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_file():
            raise FileError(
                path,
                "is no film that can be opened here: expected is the folder of a recording, or the .ome.zarr "
                "folder of a reconstructed video.",
                "Films of other programs become recordings by diffuserbench import.",
            )
        self._video = open_video(path) if is_zarr_name(path) else None
        self._run = None if self._video is not None else Run.open(path)
        if self._video is not None:
            self.indices = self._video.written
            self.period_s = self._video.period_s
            self.simulated = bool(self.facts.get("simulated"))
        else:
            assert self._run is not None
            require_video(self._run)
            self.indices = tuple(sorted(self._run.records))
            self.period_s = self._run.frame_period_s
            self.simulated = self._run.is_simulated
        if not self.indices:
            raise FileError(path, "has no pictures yet.")

    @property
    def recording(self) -> Run | None:
        """The run that its pictures are frames of; None where they were reconstructed."""
        return self._run

    @property
    def is_recording(self) -> bool:
        """Whether its pictures are frames of a camera, and nothing was reconstructed."""
        return self._run is not None

    @property
    def kind(self) -> Kind:
        """What its pictures are turned like."""
        return "frames" if self.is_recording else "results"

    @property
    def times_s(self) -> Float64Array:
        """Of its pictures; their numbers, where the rate is not known."""
        return np.array(self.indices) * (self.period_s or 1.0)

    @property
    def fps(self) -> float:
        """Pictures a second as it was taken; 25 where that is not known."""
        return 1 / self.period_s if self.period_s else DEFAULT_FPS

    def __len__(self) -> int:
        return len(self.indices)

    def read(self, place: int) -> Array:
        """Return the picture at a place among those that there are, (height, width[, 3])."""
        index = self.indices[place]
        if self._video is not None:
            return self._video.flat(index)
        assert self._run is not None
        return self._run.frame(index)

    def whole(self, place: int) -> Array:
        """Return all that is kept of a picture: of a volume its planes, ([n_z,] height, width[, 3])."""
        return self.read(place) if self._video is None else self._video.read(self.indices[place])

    @property
    def facts(self) -> dict[str, Any]:
        """What its file tells of how it was made; empty of a recording."""
        return {} if self._video is None else dict(self._video.attributes.get("diffuserbench", {}))

    @property
    def grid(self) -> Grid | None:
        """Where its pixels lie in the object; None where no file tells of it, as of a recording."""
        return None if self._video is None else self._video.grid

    def levels(self) -> tuple[float, float]:
        """Return black and white for all pictures, from some of them."""
        places = samples_of(range(len(self)))
        return levels_of([np.asarray(self.read(int(place)), np.float32) for place in places])


def open_video(path: Path) -> VideoPictures:
    """Open a video; FileError where it is something else, or damaged."""
    try:
        for name in ("zarr.json", "0/zarr.json"):
            require_file(path / name, MOST_TEXT_BYTES)
        video = VideoPictures(path)
        video.require_sound()
    except Exception as error:
        why = error.problem if isinstance(error, FileError) else ""
        words = "is no video of 'reconstruct --video'" + (f": it {why}" if why else ".")
        raise FileError(path, words, "See docs/video.md.") from error
    return video


def is_film(path: Path) -> bool:
    """Whether a path is that of a video of ``reconstruct --video`` or ``activity``."""
    if not (is_zarr_name(path) and path.is_dir()):
        return False
    try:
        open_video(path)
    except FileError:
        return False
    return True


def curves(film: Film, regions: Sequence[Window], advance: Advance | None = None) -> Float64Array:
    """Return the mean of regions in every picture, (n_regions, n_pictures); colours are averaged.

    ``advance``: ``advance(pictures done, pictures)`` after each; may raise to end the work.
    """
    found = np.empty((len(regions), len(film)))
    for place in range(len(film)):
        picture = film.read(place)
        found[:, place] = [picture[window].mean(dtype=np.float64) for window in regions]
        if advance is not None:
            advance(place + 1, len(film))
    return found


def relative(courses: Float64Array) -> Float64Array:
    """Return dF/F: the change against each course's own 20th percentile, relative to that."""
    base = np.percentile(courses, BASELINE_PERCENTILE, axis=-1, keepdims=True)
    changes: Float64Array = (courses - base) / np.maximum(np.abs(base), 1e-12)
    return changes


def write_film(
    film: Film,
    target: Path,
    *,
    fps: float | None = None,
    levels: tuple[float, float] | None = None,
    regions: Sequence[Window] = (),
    orientation: Orientation = AS_IT_IS,
    advance: Advance | None = None,
) -> Path:
    """Write a film in the format that the target's name asks for, whole or not at all; returns the target.

    Parameters
    ----------
    target : Path
        ``.mp4``, ``.gif`` (8 bit), ``.ome.zarr`` and ``.tif`` (OME-TIFF; both all values, of volumes all
        planes), ``.csv`` (means of regions). Must not exist.
    fps : float, optional
        Pictures a second; default: as it was taken.
    levels : (float, float), optional
        Values shown black and white.
    regions : sequence of (slice, slice)
        Rows and columns, for ``.csv``; none: the whole picture.
    orientation : Orientation
        How pictures are turned and mirrored in what is shown, ``.mp4`` and ``.gif``; values stay as they are.
    advance : callable, optional
        ``advance(pictures done, pictures)`` after each; may raise to end the work.

    Raises FileError when the target exists, has another suffix, or cannot be written.
    """
    name = target.name.lower()
    if not name.endswith(FILM_SUFFIXES):
        raise FileError(target, f"a film's name ends in {', '.join(FILM_SUFFIXES)}.")
    require_new(target)
    if name.endswith(".csv"):
        windows = list(regions) or [(slice(None), slice(None))]
        write_text(target, curves_csv(film, windows, curves(film, windows, advance)))
        return target
    if name.endswith(".ome.zarr"):
        _write_zarr(film, target, advance)
        return target
    if name.endswith(TIFF_SUFFIXES):
        _write_tiff(film, target, advance)
        return target
    low, high = film.levels() if levels is None else levels
    shown = (
        np.ascontiguousarray(orientation.apply(as_shown(picture, low, high)))
        for picture in _pictures(film, advance)
    )
    if name.endswith(".gif"):
        height, width = film.read(0).shape[:2]
        if (needed := len(film) * height * width) > _GIF_BYTES:
            raise FileError(
                target,
                f"a GIF of {len(film)} pictures of {height} x {width} takes {needed / 2**30:.1f} GiB of "
                f"memory; {_GIF_BYTES / 2**30:g} is the most.",
                "Write it as .mp4.",
            )
        _write_gif(target, shown, fps or film.fps)
    else:
        write_mp4(target, shown, fps or film.fps)
    return target


def slowed(target: Path, fps: float) -> str:
    """Return that a film plays slower than it is to, where its format knows no shorter times; else empty."""
    most = 1000 / _GIF_FASTEST_MS
    if target.suffix.lower() != ".gif" or fps <= most:
        return ""
    return f"{target.name}: a GIF shows {most:g} pictures a second at most; it plays at {most / fps:.2g} x."


def curves_csv(film: Film, regions: Sequence[Window], courses: Float64Array) -> str:
    """Return the means of regions and their dF/F as CSV, a line a picture; columns say where regions lie."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    height, width = film.read(0).shape[:2]
    spans = [(rows.indices(height), columns.indices(width)) for rows, columns in regions]
    names = [f"{r[0]}-{r[1]}_{c[0]}-{c[1]}" for r, c in spans]
    time = "time_s" if film.period_s else "frame_number"
    writer.writerow(["frame", time, *(f"mean_{n}" for n in names), *(f"dff_{n}" for n in names)])
    for index, at, means, changes in zip(
        film.indices, film.times_s, courses.T, relative(courses).T, strict=True
    ):
        writer.writerow([index, f"{at:.12g}", *(f"{v:.6g}" for v in means), *(f"{v:.5f}" for v in changes)])
    return text.getvalue()


def _pictures(film: Film, advance: Advance | None, *, whole: bool = False) -> Iterator[Array]:
    for place in range(len(film)):
        yield film.whole(place) if whole else film.read(place)
        if advance is not None:
            advance(place + 1, len(film))


def _write_zarr(film: Film, target: Path, advance: Advance | None) -> None:
    """Write all values, each picture at its own time: those that are not there are not in the copy either."""
    about = {**film.facts, "of": str(film.path.resolve()), "simulated": film.simulated}
    shape, count = film.whole(0).shape, film.indices[-1] + 1
    create_output(target, count, shape, period_s=film.period_s, grid=film.grid, attributes=about)
    try:
        made = VideoPictures(target, write=True)
        for place, index in enumerate(film.indices):
            made.write(index, np.asarray(film.whole(place), np.float32))
            if advance is not None:
                advance(place + 1, len(film))
        made.say_white(samples_of(film.indices))
    except BaseException:
        shutil.rmtree(target)
        raise


def _write_tiff(film: Film, target: Path, advance: Advance | None) -> None:
    """Write all values of the pictures that there are, with their times; of a recording its own numbers."""
    if film.recording is not None:
        export(film.recording, target, on_progress=advance)
        return
    pictures = (np.asarray(picture, np.float32) for picture in _pictures(film, advance, whole=True))
    about = {**film.facts, "of": str(film.path.resolve()), "simulated": film.simulated}
    about["frames"] = ranges(list(film.indices))
    times_s = film.times_s if film.period_s else None
    write_film_tiff(target, pictures, (len(film), *film.whole(0).shape), film.grid, times_s, about)


def _write_gif(target: Path, shown: Iterator[npt.NDArray[np.uint8]], fps: float) -> None:
    """Write a GIF that plays without end."""
    from PIL import Image  # of Matplotlib's own needs

    frames = (Image.fromarray(picture).quantize(256) for picture in shown)
    first = next(frames)
    duration_ms = max(round(1000 / fps / _GIF_MS) * _GIF_MS, _GIF_FASTEST_MS)
    with whole_file(target) as temporary:
        first.save(
            temporary,
            "gif",
            save_all=True,
            append_images=frames,
            duration=duration_ms,
            loop=0,
            optimize=False,
        )
