"""Tasks: work on files, from declared options to written results, as terminal and window offer it alike.

This table is light: a task is imported when it is asked for. A new one is a function with :func:`task
<instrument.tasks.task.task>` and one row here; command, help, form, progress and results follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from instrument.tasks.task import Task


class TaskEntry(NamedTuple):
    """A row of the table; ``place``, in this package, is imported only when the task is asked for."""

    group: str
    title: str
    """In the window."""
    help: str
    place: str
    """``module:function``."""

    def load(self) -> Task:
        """Import the task."""
        import importlib

        module, _, name = self.place.partition(":")
        task: Task = getattr(importlib.import_module(f"instrument.tasks.{module}"), name)
        return task


RUNS = "Runs"
CALIBRATIONS = "Calibrations"
VIDEOS = "Recordings"
DISPLAY = "Holographic display"
CHARTS = "Charts and maps"

TASKS: Mapping[str, TaskEntry] = {
    "verify": TaskEntry(RUNS, "Verify runs", "read every frame of a run and check it", "runs:verify"),
    "export": TaskEntry(
        RUNS,
        "Export frames or a result",
        "write a run's frames as TIFF, HDF5, NumPy, PNG, MP4",
        "runs:export",
    ),
    "import": TaskEntry(
        RUNS, "Import a film", "make a recording of another program's film", "runs:import_film"
    ),
    "video": TaskEntry(
        VIDEOS, "Reconstruct a recording", "every frame of a recording, to a video", "video:video"
    ),
    "activity": TaskEntry(
        VIDEOS, "Find activity", "fluorescence over time: dF/F, regions, traces", "activity:activity"
    ),
    "points": TaskEntry(
        RUNS,
        "Find points in a volume",
        "beads or cells in a volume: x, y, z in um, as a table",
        "points:points",
    ),
    "patterned": TaskEntry(
        VIDEOS,
        "Reconstruct patterned light",
        "one picture of a scene lit by patterns in turn",
        "solving:patterned",
    ),
    "etendue": TaskEntry(
        DISPLAY,
        "Field of view and eyebox",
        "field of view, eyebox and resolution of a holographic display",
        "display:etendue",
    ),
    "table7.1": TaskEntry(
        DISPLAY,
        "Table 7.1",
        "the dissertation's comparison of methods, also without aliasing",
        "display:table",
    ),
    "chart scene": TaskEntry(
        CHARTS, "Chart a simulated scene", "time and memory against error, for every method", "chart:scene"
    ),
    "chart photograph": TaskEntry(
        CHARTS, "Chart your photograph", "every method on your own, by pixels held out", "chart:photograph"
    ),
    "chart hologram": TaskEntry(
        CHARTS, "Chart holograms", "every loss, method and number of frames of a picture", "chart:hologram"
    ),
    "chart calibrations": TaskEntry(
        CHARTS, "Chart calibrations", "what more photographs of a calibration buy", "chart:calibrations"
    ),
    "stability": TaskEntry(
        CHARTS,
        "Map where methods fail",
        "map where methods fail, against pairs of stresses",
        "stability:stability",
    ),
    "limit": TaskEntry(
        DISPLAY, "Limit of the display", "what any number of frames could reach for a picture", "spots:limit"
    ),
    "spots": TaskEntry(
        DISPLAY, "Hologram of spots", "spots as bright as asked for, at any places and depths", "spots:spots"
    ),
    "analyze": TaskEntry(
        CALIBRATIONS,
        "Analyse a calibration",
        "what a calibration's optics can do: one page and JSON",
        "calibrations:analyze",
    ),
    "compare": TaskEntry(
        CALIBRATIONS,
        "Compare two calibrations",
        "two calibrations: what moved, is a new one due",
        "calibrations:compare",
    ),
    "optics": TaskEntry(
        CALIBRATIONS,
        "Compare kinds of optics",
        "objective, diffuser, lenslets side by side at equal light",
        "optics:optics",
    ),
    "refocus": TaskEntry(
        CALIBRATIONS,
        "Refocus a calibration",
        "bring a calibrated PSF to another depth",
        "calibrations:refocus",
    ),
}
"""By the names of their commands, with sub-commands, or of what a command does besides."""
