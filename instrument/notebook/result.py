"""A reconstruction with what it was made of: it shows itself, draws itself, is saved in one line."""

from __future__ import annotations

import html
import sys
import warnings
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import require_new
from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile, read_image, write_image
from instrument.files.seen import as_seen, png_bytes
from instrument.notebook.words import in_python, job_in_python, result_in_python, speaking
from instrument.reconstruction.job import Job
from instrument.reconstruction.result_file import (
    Outputs,
    reconstruction_record,
    write_reconstruction,
    write_volume,
)
from recon.arrays import Array
from recon.base.arguments import require_argument
from recon.base.handed_on import lacking
from recon.reconstruction.result import Reconstruction
from recon.types import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Shown = npt.NDArray[np.uint8]
_FILES = (str, Path, ImageFile)


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class Result(Reconstruction):
    """A :class:`~recon.Reconstruction` that shows and saves itself.

    Attributes
    ----------
    job : Job
        Photograph, calibration, and what was done to them; in ``job.notes`` in words.
    typed : (Reconstruction, Job)
        The same with options named as in a terminal, which is how they are written down.
    """

    job: Job = field(kw_only=True)
    typed: tuple[Reconstruction, Job] = field(kw_only=True)

    @classmethod
    def of(cls, found: Reconstruction, job: Job) -> Result:
        """Return a reconstruction with what it was made of."""
        told = result_in_python(found)
        values = {f.name: getattr(told, f.name) for f in fields(Reconstruction)}
        return cls(**values, job=job_in_python(job), typed=(found, job))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            raise lacking(self, name)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        """Return the picture's pixels, (height, width) or with colours last; of a volume all its planes."""
        pixels: Array = self.image if self.is_picture else self.volume
        return np.array(pixels, dtype, copy=copy)

    def facts(self) -> Mapping[str, str]:
        """Return what is known of it, in words: what was read, chosen, and how far it can be trusted."""
        from instrument.reconstruction.stored_result import StoredResult

        record = reconstruction_record(self, self.job, volume=not self.is_picture)
        pixels = self.image if self.is_picture else self.volume
        said = StoredResult(Path(), pixels, None, record).facts()
        notes = {**dict(self.job.notes), **{name: text for name, text in said if name != "Made"}}
        return {name: in_python(text) for name, text in notes.items()}

    def seen(self, *, rotate_deg: int = 0) -> Shown:
        """Return the picture for a screen, 8 bit; of a volume the brightest over depth, coloured by depth."""
        if self.is_picture:
            return as_seen(np.rot90(self.image, _turns(rotate_deg)))
        from instrument.reconstruction.result_figures import volume_seen

        return np.rot90(volume_seen(self.volume), _turns(rotate_deg))

    def plot(self, axes: Axes | None = None, *, rotate_deg: int = 0) -> Axes:
        """Draw the picture into Matplotlib axes, its own or given ones, and return them."""
        if axes is None:
            from matplotlib import pyplot

            axes = pyplot.subplots()[1]
        elif not hasattr(axes, "imshow"):
            raise BenchError(f"plot draws into Matplotlib axes (pyplot.subplots()[1]), not {axes!r:.60}.")
        axes.imshow(self.seen(rotate_deg=rotate_deg), cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
        axes.set_title(_title(self), fontsize=9)
        return axes

    def figure(self, *, rotate_deg: int = 0) -> Figure:
        """Return a page: PSF, photograph, reconstruction, how it converged, facts; of a volume its views."""
        from instrument.reconstruction import result_figures

        if self.is_picture:
            return result_figures.picture_figure(self, self.job, rotate_deg=rotate_deg)
        return result_figures.volume_figure(self, simulated=self.job.simulated)

    def show(self, *, rotate_deg: int = 0) -> None:
        """Show the page: below the cell of a notebook, else in a window."""
        show_figure(self.figure(rotate_deg=rotate_deg))

    @speaking
    def save(
        self,
        out: Path | str,
        *,
        overwrite: bool = False,
        rotate_deg: int = 0,
        figure: Path | str | None = None,
    ) -> tuple[Path, ...]:
        """Write it, and return the files.

        Parameters
        ----------
        out : path
            ``.tif`` (volumes also ``.ome.zarr``): the numbers, float32, with a preview and a record of how
            they were made beside them, as the terminal writes them. ``.npy``: the numbers alone. ``.png``:
            the picture as it is seen.
        overwrite : bool
            Whether files that exist may be replaced.
        rotate_deg : int
            A multiple of 90: turns a picture counter-clockwise.
        figure : path, optional
            Also the page (.png, .pdf, .svg).

        Raises FileError when a file exists or cannot be written, naming it; BenchError for another angle.
        """
        require_argument("out", out, Path)
        require_argument("figure", figure, Path | None)
        out, page = Path(out), None if figure is None else Path(figure)
        turns = _turns(rotate_deg)
        if turns and not self.is_picture and out.suffix.lower() != ".png":
            raise BenchError("rotate_deg turns pictures, and what is seen of a volume: leave it out here.")
        if page is not None:
            require_new(page, overwrite=overwrite)
        if out.suffix.lower() in (".png", ".npy"):
            require_new(out, overwrite=overwrite)
            pixels: Array = self.seen(rotate_deg=rotate_deg)
            if out.suffix.lower() == ".npy":
                pixels = np.rot90(self.image, turns) if self.is_picture else self.volume
            write_image(out, pixels)
            written: tuple[Path, ...] = (out,)
        else:
            volume = not self.is_picture
            zarr = volume and out.suffix.lower() == ".zarr"
            if out.suffix.lower() not in (".tif", ".tiff") and not zarr:
                raise FileError(
                    out,
                    f"is not written: the name must end in .tif{' or .ome.zarr' * volume} (the numbers, with "
                    "preview and record), .npy (the numbers alone) or .png (the picture as it is seen).",
                )
            outputs = Outputs.named(
                out, volume=volume, uncertainty=self.uncertainty is not None and not volume
            )
            outputs.check(self.volume.size, overwrite=overwrite)
            if volume:
                write_volume(outputs, *self.typed)
            else:
                write_reconstruction(outputs, *self.typed, rotate_deg=rotate_deg)
            written = outputs.written(self)
        if page is not None:
            from instrument.files.figures import save_figure

            written = (*written, save_figure(self.figure(rotate_deg=rotate_deg), page))
        return written

    def _repr_html_(self) -> str:
        picture = b64encode(png_bytes(self.seen())).decode()
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
            for name, text in self.facts().items()
        )
        doubts = "".join(f"<p>{html.escape(said)}</p>" for said in (*self.job.warnings, *self.warnings))
        mark = "<b>SIMULATED</b> " if self.job.simulated else ""
        return (
            f"<p>{mark}{html.escape(repr(self)[1:-1])}</p>"
            f"<img style='max-width:100%;min-width:256px' src='data:image/png;base64,{picture}'/>"
            f"<details><summary>How it was made</summary><table>{rows}</table></details>{doubts}"
        )


def _turns(rotate_deg: int) -> int:
    if rotate_deg % 90:
        raise BenchError(f"rotate_deg is a multiple of 90, not {rotate_deg}.")
    return rotate_deg // 90


def _title(shown: object) -> str:
    """Say in a line what a picture is."""
    if isinstance(shown, Reconstruction):
        verdict = "" if shown.verdict is None else "; " + shown.verdict.sentences[0].partition(":")[0]
        return f"{shown.prior} by {shown.solver}, {shown.seconds:.1f} s{verdict}"
    return shown.path.name if isinstance(shown, ImageFile) else ""


def show(*pictures: Any, **titled: Any) -> None:
    """Show pictures beside one another, below the cell of a notebook, else in a window.

    Parameters
    ----------
    *pictures, **titled
        Results, files, arrays (height, width[, 3]), calibrations (the PSF nearest to the axis); with a title
        where given by name: ``db.show(photo, tv=first, l1=second)``.

    Raises BenchError when one of them is no picture, FileError when one cannot be read.
    """
    show_figure(figure_of(*pictures, **titled))


@speaking
def figure_of(*pictures: Any, **titled: Any) -> Figure:
    """Return the figure that :func:`show` shows."""
    from matplotlib.figure import Figure

    panels = [*(("", picture) for picture in pictures), *titled.items()]
    panels = [(name, read_image(p, holes=True) if isinstance(p, _FILES) else p) for name, p in panels]
    if not panels:
        raise BenchError("There is nothing to show: give results, images or arrays.")
    figure = Figure(figsize=(4.5 * len(panels), 4.2), layout="constrained")
    for axes, (name, picture) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        axes.imshow(_pixels(picture), cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
        axes.set_title(": ".join(filter(None, (name, _title(picture)))), fontsize=9)
    return figure


def _pixels(picture: Any) -> Shown:
    if isinstance(picture, Result):
        return picture.seen()
    if isinstance(picture, Reconstruction):
        picture = picture.image
    if isinstance(picture, Calibration):
        picture = np.moveaxis(picture.psfs[picture.nearest_to_axis()], 0, -1).squeeze()
    array = np.asarray(picture)
    if array.dtype.kind not in "uifb" or array.ndim not in (2, 3) or not array.size:
        raise BenchError(
            f"A picture is (height, width) or (height, width, channels) of real numbers; this is "
            f"{array.dtype} {array.shape}."
        )
    array = array.astype(np.float32) if array.dtype == bool else array
    return as_seen(array, raw=array.dtype.kind == "u")


def figure_png(figure: Figure) -> bytes:
    """Return a figure as PNG: what a notebook shows."""
    png = BytesIO()
    figure.savefig(png, format="png")
    return png.getvalue()


def show_figure(figure: Figure) -> None:
    """Show a Matplotlib ``figure`` where there is a place for it; say where there is none.

    Raises BenchError for what is no figure.
    """
    if not hasattr(figure, "savefig"):
        raise BenchError(
            f"A figure of Matplotlib is shown, as result.figure() gives it, not {type(figure).__name__}: "
            "db.show(...) shows pictures."
        )
    ipython = sys.modules.get("IPython")
    if ipython is not None and ipython.get_ipython() is not None:
        shown: Any = import_module("IPython.display")  # installed or not, typed or not
        shown.display(shown.Image(figure_png(figure)))
        return
    import matplotlib
    from matplotlib.backends.registry import BackendFilter, backend_registry

    interactive: list[str] = backend_registry.list_builtin(BackendFilter.INTERACTIVE)  # type: ignore[no-untyped-call]
    if matplotlib.get_backend().lower() not in interactive:
        warnings.warn(
            "There is no screen for a window here: .save('scene.png') writes the picture, "
            ".figure().savefig('page.png') the page.",
            stacklevel=3,
        )
        return
    from matplotlib import pyplot

    window = pyplot.figure().canvas.manager
    assert window is not None
    window.canvas.figure = figure
    figure.set_canvas(window.canvas)
    pyplot.show()
