"""The table of commands.

A new command is one row here and one :class:`~instrument.cli.app.App`: ``app`` of its module, or
``module:name``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from instrument.cli.app import App


class Command(NamedTuple):
    """A row of the table; ``place``, in this package, is imported only when the command is used."""

    group: str
    help: str
    place: str

    def load(self) -> App:
        """Import the command's application."""
        import importlib

        module, _, name = self.place.partition(":")
        app: App = getattr(importlib.import_module(f"instrument.cli.{module}"), name or "app")
        return app


BENCH = "The bench"
ACQUISITION = "Acquisition"
RECONSTRUCTION = "Reconstruction"
ANALYSIS = "Calibration and analysis"
DISPLAY = "Holographic display"

COMMANDS: Mapping[str, Command] = {
    "demo": Command(BENCH, "the main job, start to end, on the simulated bench", "demo"),
    "gui": Command(BENCH, "the desktop program: live view, stage, sweeps, results", "bench:gui_app"),
    "new": Command(BENCH, "write a commented bench.toml (simulated by default)", "bench:new_app"),
    "check": Command(BENCH, "open every device of the bench and report on it", "bench:check_app"),
    "drivers": Command(BENCH, "list the installed drivers by kind of device", "bench:drivers_app"),
    "devices": Command(
        BENCH,
        "list what is connected: USB, HID, serial, video, GenICam, displays",
        "bench:devices_app",
    ),
    "calibrate": Command(BENCH, "measure PSFs, the sensor, the diffuser, or an SLM", "calibrate"),
    "snap": Command(BENCH, "take a photograph", "capture:snap_app"),
    "plan": Command(ACQUISITION, "look at a plan before anything moves, or write one", "plan"),
    "run": Command(ACQUISITION, "carry out a plan", "acquire:run_app"),
    "resume": Command(ACQUISITION, "go on with a run that did not end", "acquire:resume_app"),
    "record": Command(ACQUISITION, "record video at full camera rate", "capture:record_app"),
    "list": Command(ACQUISITION, "list the runs in a folder", "runs:list_app"),
    "show": Command(ACQUISITION, "say what is in a run; or show a hologram on the SLM", "show"),
    "verify": Command(ACQUISITION, "read every frame of a run and check it", "runs:verify_app"),
    "export": Command(ACQUISITION, "write a run's frames as TIFF, HDF5, NumPy, PNG, MP4", "runs:export_app"),
    "reconstruct": Command(
        RECONSTRUCTION, "reconstruct the scene from a PSF and a photograph", "reconstruct"
    ),
    "activity": Command(RECONSTRUCTION, "fluorescence over time: dF/F, regions, traces", "activity"),
    "analyze": Command(
        ANALYSIS,
        "what a calibration's optics can do: one page and JSON",
        "calibrations:analyze_app",
    ),
    "compare": Command(
        ANALYSIS, "two calibrations: what moved, is a new one due", "calibrations:compare_app"
    ),
    "chart": Command(ANALYSIS, "time and memory against error, for every method", "chart"),
    "stability": Command(ANALYSIS, "map where methods fail, against pairs of stresses", "stability"),
    "refocus": Command(ANALYSIS, "bring a calibrated PSF to another depth", "calibrations:refocus_app"),
    "hologram": Command(DISPLAY, "compute the SLM phase that shows a picture through the mask", "hologram"),
    "align": Command(DISPLAY, "find the scattering mask and bring it to its place", "calibrate:align_app"),
    "table7.1": Command(
        DISPLAY,
        "the dissertation's comparison of methods, also without aliasing",
        "display:table_app",
    ),
    "etendue": Command(
        DISPLAY,
        "field of view, eyebox and resolution of a holographic display",
        "display:etendue_app",
    ),
}
