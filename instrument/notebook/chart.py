"""Charts in a notebook: what every setting costs on a photograph of one's own, against how good it is."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from instrument.evaluation.chart import ChartData, make_chart, title_of
from instrument.evaluation.chart_figure import chart_figure
from instrument.evaluation.chart_problems import problem_of_job, problem_of_scene
from instrument.evaluation.figures import write_charts
from instrument.files.atomic import write_json
from instrument.files.errors import BenchError
from instrument.notebook.result import Result, figure_png, show_figure
from instrument.notebook.words import speaking
from recon.base.arguments import require_argument
from recon.evaluation.scene import FAMILIES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Chart(ChartData):
    """A :class:`ChartData` that shows and saves itself."""

    def __repr__(self) -> str:
        """Say in a line what it is."""
        settings = {point.setting for point in self.points}
        return (
            f"<Chart of {title_of(self)}: {len(settings)} settings, {len(self.front())} points on the front>"
        )

    def figure(self) -> Figure:
        """Return the chart as a figure."""
        return chart_figure(self)

    def _repr_png_(self) -> bytes:
        return figure_png(self.figure())

    def show(self) -> None:
        """Show it: below the cell of a notebook, else in a window."""
        show_figure(self.figure())

    @speaking
    def save(self, folder: Path | str) -> tuple[Path, ...]:
        """Write chart.png, .html, .csv and .json into a folder; errors as ``write_text``."""
        folder = Path(require_argument("folder", folder, Path))
        folder.mkdir(parents=True, exist_ok=True)
        record = folder / "chart.json"
        write_json(record, self.to_json())
        return (record, *write_charts(folder, self))


@speaking
def chart(
    subject: Result | str,
    *,
    budget_s: float = 60.0,
    size: int = 48,
    seed: int = 0,
    folder: Path | str | None = None,
    on_progress: Callable[[str, float], object] | None = None,
) -> Chart:
    """Chart every method, model, prior, binning and precision, each in its own process, quick ones first.

    A script needs ``if __name__ == "__main__":`` around it, as with all processes of Python; a notebook not.

    Parameters
    ----------
    subject : Result or str
        A result: its photograph, scored by pixels that are held out. Or the name of a simulated scene with
        ground truth (``"sparse-picture"``, ``"beads"`` ...).
    size, seed : int
        Of a simulated scene: pixels along a side, and which draw.
    budget_s : float
        Seconds for all settings together.
    folder : path, optional
        Where the chart is kept while it is made: the same call goes on where it stopped.
    on_progress : callable, optional
        ``on_progress(setting, seconds_left)`` before each.

    Returns
    -------
    Chart
        Each setting's time, memory and error as it iterates; ``front()``, ``show()``, ``save(folder)``.

    Raises BenchError when there was no time for any setting; InputError when the subject cannot be charted.
    """
    require_argument("budget_s", budget_s, float, above=0)
    require_argument("size", size, int, least=1)
    require_argument("seed", seed, int, least=0)
    require_argument("folder", folder, Path | None)
    require_argument("on_progress", on_progress, Callable | None)
    if not isinstance(subject, Result) and not (isinstance(subject, str) and subject in FAMILIES):
        given = repr(subject) if isinstance(subject, str) else type(subject).__name__
        raise BenchError(
            f"{given} is neither a result nor a scene ({', '.join(FAMILIES)}). A photograph of your own "
            "is charted by its result: db.chart(db.reconstruct(photo, psf))."
        )
    if isinstance(subject, Result):
        asked = subject.provenance.get("options", {}).get("z_um")
        problem, about = problem_of_job(subject.job, asked, volume=not subject.is_picture)
    else:
        problem, about = problem_of_scene(subject, size, seed)
    with tempfile.TemporaryDirectory() as scratch:
        kept = Path(scratch if folder is None else folder)
        kept.mkdir(parents=True, exist_ok=True)

        told = -1

        def tell(place: int, _total: int, setting: object, left_s: float) -> None:
            nonlocal told
            if on_progress is not None and place != told:  # which is told while it runs, too
                told = place
                on_progress(str(getattr(setting, "name", setting)), left_s)

        data = make_chart(problem, about, kept / "chart.json", budget_s=budget_s, on_progress=tell)
    if not data.points:
        raise BenchError("There was no time for any setting: give a longer budget_s.")
    return Chart(**{f.name: getattr(data, f.name) for f in fields(ChartData)})
