"""Exports of the result that a panel shows: all values, or its views as pictures; asks before it replaces."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gui.jobs import Job, JobContext
from gui.panel import Panel
from gui.widgets.dialogues import Question, choose_path
from instrument.files.atomic import protecting
from instrument.files.errors import BenchError
from instrument.files.images import write_image
from instrument.files.orientation import Orientation
from instrument.reconstruction.stored_result import StoredResult, export_result
from instrument.volumes.grid_facts import uneven_steps

Pixels = npt.NDArray[np.uint8]
"""In the colours that they show, (height, width, 3)."""


class ResultExport:
    """Writes what a panel shows.

    Parameters
    ----------
    panel : Panel
        Whose line has what was refused.
    result : callable
        Returns the result that is open; None where none is.
    shown : callable
        Returns its views as they are now, by name.
    orientation : callable
        Returns how pictures are turned.
    """

    def __init__(
        self,
        panel: Panel,
        result: Callable[[], StoredResult | None],
        shown: Callable[[], dict[str, Pixels]],
        orientation: Callable[[], Orientation],
    ) -> None:
        self._panel, self._result, self._shown = panel, result, shown
        self._orientation = orientation

    def choose(self) -> None:
        """Ask where to, then write."""
        result = self._result()
        if result is None:
            return
        values = "*.tif *.npy" if result.volume is None else "*.tif *.ome.zarr *.npy"
        filters = f"All values ({values});;What is shown (*.png)"
        start = str(result.path.parent)
        choose_path(self._panel, "save", "Export", start, partial(self._chosen, result), filters)

    def _chosen(self, result: StoredResult, target: Path) -> None:
        """Export the result that the name was chosen for, after asking whether files may be replaced."""
        if not self._still_shown(result):
            return
        views = self._views_for(target)  # what is asked about now is what is written after the answer

        def answered(agreed: bool) -> None:
            if agreed and self._still_shown(result):
                self.to(target, overwrite=True, views=views)

        def looked(present: list[str]) -> None:
            if present:
                text = f"{', '.join(present)}: exists already. Replace it?"
                Question(self._panel, "Replace?", text, ("Replace", "Keep"), answered).ask()
            elif self._still_shown(result):
                self.to(target, views=views)

        files = list(views or (target,))
        jobs = self._panel.jobs
        look = jobs.watch("Looking for files", lambda _: [file.name for file in files if file.exists()])
        self._panel.follow(look).succeeded.connect(looked)

    def _still_shown(self, result: StoredResult) -> bool:
        """Whether a result is still open; says so where another was opened while the operator was asked."""
        if self._result() is result:
            return True
        said = f"{result.path.name} is not open any more: nothing was exported. Open it again."
        self._panel.refused(None, said)
        return False

    def _views_for(self, target: Path) -> dict[Path, Pixels] | None:
        """Return the files of a ``.png`` export, each with what it shows now; None for all values."""
        if target.suffix.lower() != ".png":
            return None
        shown = self._shown()
        if len(shown) == 1:
            return {target: next(iter(shown.values()))}
        return {target.with_name(f"{target.stem}-{name}.png"): pixels for name, pixels in shown.items()}

    def to(
        self, target: Path, *, overwrite: bool = False, views: dict[Path, Pixels] | None = None
    ) -> Job | None:
        """Write what is shown (``.png``: one file for each view), or all values, as the name asks for.

        ``views`` are the files of a ``.png`` as they were when the name was chosen; default: as they are now.
        """
        result, panel = self._result(), self._panel
        if result is None:
            return None
        views = self._views_for(target) if views is None else views
        if views is not None and not views:
            panel.refused(None, "The volume's views are still being read. Export them when they are shown.")
            return None
        orientation = self._orientation()

        def write(context: JobContext) -> list[Path]:
            with protecting(result.inputs):
                return write_views(context)

        def write_views(context: JobContext) -> list[Path]:
            if views is None:
                export_result(
                    result,
                    target,
                    orientation=orientation,
                    overwrite=overwrite,
                    advance=lambda done, total: context.report(done / total),
                )
                return [target]
            for path, pixels in views.items():
                if path.exists() and not overwrite:
                    raise BenchError(f"{path}: exists already and was left as it is.")
                write_image(path, pixels)
            return list(views)

        job = panel.follow(panel.jobs.compute(f"Exporting {target.name}", write))
        planes_um = None if views is not None or target.suffix.lower() == ".npy" else result.planes_um
        steps = "" if planes_um is None else uneven_steps(planes_um[0])

        def written(files: list[Path]) -> None:
            panel.session.log("info", f"Wrote {', '.join(map(str, files))}")
            if steps:
                panel.session.log("warning", f"{target.name}: {steps}")

        job.succeeded.connect(written)
        return job
