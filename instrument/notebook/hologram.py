"""Holograms in a notebook: from a picture to the SLM's pattern and what will be seen of it."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from instrument.bench.config import BenchConfig
from instrument.display.alignment import load_alignment
from instrument.display.bench_display import bench_display, slm_size
from instrument.display.hologram import (
    HologramResult,
    compute_and_judge,
    field_words,
    prepare_target,
    read_picture,
)
from instrument.display.hologram_files import HologramFiles, hologram_figure
from instrument.display.hologram_forecast import forecast_hologram as by_its_beginning
from instrument.files.errors import BenchError
from instrument.files.images import ImageFile
from instrument.files.pictures import drop_alpha
from instrument.files.sample_images import SAMPLES
from instrument.notebook.reconstruct import bench_config, require_hooks
from instrument.notebook.result import figure_png, show_figure
from instrument.notebook.words import in_python, speaking
from instrument.reconstruction.forecast import Forecast
from recon.base.arguments import is_several, require_argument, require_shape
from recon.base.declare import with_overrides
from recon.holography import Display, HologramOptions, HologramRecord, Target
from recon.types import plain_array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Picture = Path | str | ImageFile | npt.ArrayLike


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class HologramShown(HologramResult):
    """A :class:`HologramResult` that shows and saves itself.

    Attributes
    ----------
    files : HologramFiles
        What it was computed for.
    """

    files: HologramFiles = field(kw_only=True)

    def __repr__(self) -> str:
        """Say in a line what it is and how good."""
        height, width = self.hologram.slm.shape[-2:]
        score, display = self.scores[0], self.files.displays[0]
        return (
            f"<Hologram {height} x {width}, expansion {display.expansion}: {score.psnr_db:.1f} dB, "
            f"SSIM {score.ssim:.2f}, {self.efficiency:.1%} of the light, {self.hologram.seconds:.1f} s>"
        )

    @property
    def phase_rad(self) -> npt.NDArray[np.floating]:
        """The pattern, (n_frames, height, width), radians."""
        return np.asarray(self.hologram.phase_rad)

    def figure(self) -> Figure:
        """Return a page: wanted and seen picture, raw light, the SLM's phase, how it was optimised."""
        lines = [(name, str(value)) for name, value in self.files.display_facts(0).items()]
        return hologram_figure(self, title="Hologram", facts=lines)

    def _repr_png_(self) -> bytes:
        return figure_png(self.figure())

    def show(self) -> None:
        """Show the page: below the cell of a notebook, else in a window."""
        show_figure(self.figure())

    @speaking
    def save(self, out: Path | str, *, overwrite: bool = False) -> tuple[Path, ...]:
        """Write pattern, description and preview as the terminal does; ``.png``, of a complex SLM ``.npy``.

        Raises FileError when a file exists or cannot be written.
        """
        require_argument("out", out, Path)
        files = HologramFiles(Path(out), self.files.binning, self.files.options, self.files.displays)
        files.check(overwrite=overwrite)
        files.write(0, 0, self)
        return tuple(files.files())


@speaking
def hologram(
    picture: Picture | Sequence[Path | str | ImageFile],
    bench: BenchConfig | Path | str | None = None,
    options: HologramOptions | None = None,
    *,
    slm: tuple[int, int] | None = None,
    z_mm: float | Sequence[float] = 0.0,
    on_progress: Callable[[HologramRecord, Any], object] | None = None,
    cancel: threading.Event | None = None,
    **overrides: Any,
) -> HologramShown:
    """Compute the SLM's pattern that shows a picture through the bench's mask, and what will be seen of it.

    Parameters
    ----------
    picture : path, image, array, or the name of a sample; or a list of files
        Intensity; of several one a plane, with a ``z_mm`` each.
    bench : path or str, optional
        As for ``db.bench``: its SLM and ``[display]`` are computed for.
    options : HologramOptions, optional
    slm : (int, int), optional
        Other SLM pixels than the bench's, height and width: few, for a quick look.
    z_mm : float or sequence of float
        Depth behind the focal plane, millimetres.
    on_progress : callable, optional
        ``on_progress(record, slm)`` after each iteration.
    cancel : threading.Event, optional
        Set it to stop.
    **overrides
        Single options by name; ``alignment``: a file of ``align mask``.

    Returns
    -------
    HologramShown
        ``phase_rad``, (n_frames, height, width), radians; ``seen``, an image a plane in units of the target's
        white, and how good they are. It shows and saves itself.

    Raises InputError, BenchError or FileError: what was found, what was expected, what to do.
    """
    require_hooks(on_progress, cancel)
    asked = _Asked.of(picture, bench, options, slm, z_mm, overrides)
    if asked.said:
        warnings.warn(in_python(asked.said), stacklevel=3)
    found = compute_and_judge(
        asked.display, asked.targets, asked.options, callback=on_progress, cancel=cancel
    )
    files = HologramFiles(Path("slm.png"), asked.config.display.slm_binning, asked.options, [asked.display])
    return HologramShown(**{f.name: getattr(found, f.name) for f in fields(HologramResult)}, files=files)


@speaking
def forecast_hologram(
    picture: Picture | Sequence[Path | str | ImageFile],
    bench: BenchConfig | Path | str | None = None,
    options: HologramOptions | None = None,
    *,
    slm: tuple[int, int] | None = None,
    z_mm: float | Sequence[float] = 0.0,
    **overrides: Any,
) -> Forecast:
    """Say what time and memory a hologram will take here, as busy as this machine is now.

    Its first iterations are carried out, all of it where that takes a few seconds: the same that
    ``diffuserbench hologram --explain`` tells.

    Parameters
    ----------
    picture, bench, options, slm, z_mm, **overrides
        As of :func:`hologram`, whose errors it raises.

    Returns
    -------
    Forecast
        Seconds, and bytes at the peak beyond what the program takes.
    """
    asked = _Asked.of(picture, bench, options, slm, z_mm, overrides)
    return by_its_beginning(asked.display, asked.targets, asked.options)


@dataclass(frozen=True)
class _Asked:
    """What a hologram is computed for."""

    config: BenchConfig
    display: Display
    targets: list[Target]
    options: HologramOptions
    said: str
    """Of the pictures: notes on their files, what is cropped."""

    @classmethod
    def of(
        cls,
        picture: Any,
        bench: Any,
        options: HologramOptions | None,
        slm: Any,
        z_mm: Any,
        overrides: dict[str, Any],
    ) -> Self:
        """Bring it together; errors as :func:`hologram`."""
        alignment = overrides.pop("alignment", None)
        require_argument("alignment", alignment, Path | None)
        require_argument(
            "options", options, HologramOptions | None, "Single ones are given by name: frames=2."
        )
        options = with_overrides(options or HologramOptions(), overrides)
        config = bench_config(bench)
        shape, pitch_um = slm_size(config, phases=options.mirrors is None)
        shape = shape if slm is None else require_shape("slm", slm)
        display = options.display_of(bench_display(config, (shape, pitch_um), expansion=options.expansion))
        if alignment is not None:
            display = load_alignment(Path(alignment)).of(display)
        pictures = list(picture) if isinstance(picture, list | tuple) else [picture]
        depths = _depths(z_mm, len(pictures))
        images = [_image(one, options) for one in pictures]
        said = [f"{image.path}: {note}." for image in images for note in image.notes]
        said += list(filter(None, (field_words(image.pixels, options.fit) for image in images)))[:1]
        targets = [
            prepare_target(image.pixels, display, options, z_mm=z)
            for image, z in zip(images, depths, strict=True)
        ]
        return cls(config, display, targets, options, " ".join(said))


def _depths(z_mm: Any, count: int) -> list[float]:
    """Return a depth for each picture; raises BenchError where there are others."""
    given = list(z_mm) if is_several(z_mm) else [z_mm]
    given = [require_argument("z_mm", z, float) for z in given]
    if not count or len(given) not in (1, count):
        raise BenchError(
            f"Give one z_mm for all pictures, or one a picture: there are {count}, not {len(given)}."
        )
    return [float(z) for z in given] * (count if len(given) == 1 else 1)


def _image(picture: Any, options: HologramOptions) -> ImageFile:
    """Return a picture as of a file: an array's alpha channel is left out as a file's is, and that noted."""
    if isinstance(picture, str) and picture in SAMPLES and not Path(picture).exists():
        sample: Any = SAMPLES[picture].load()
        return ImageFile(Path(picture), np.asarray(sample))
    if isinstance(picture, Path | str | ImageFile):
        return read_picture(picture, options)
    pixels: Any = plain_array(picture)
    notes: tuple[str, ...] = ()
    if pixels.ndim == 3:
        pixels, notes = drop_alpha(pixels)
    one = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (1, 3))
    if pixels.dtype.kind not in "uifb" or not one or not pixels.size:
        raise BenchError(
            "A picture is a file, the name of a sample, or an array (height, width) or (height, width, 3) of "
            f"real numbers, not {type(picture).__name__} {pixels.dtype} {np.shape(picture)}."
        )
    return ImageFile(Path("the picture, an array"), pixels, notes)
