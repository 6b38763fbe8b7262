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
    """A row of the table; ``place`` is imported only when the command is used."""

    group: str
    help: str
    place: str

    def load(self) -> App:
        """Import the command's application."""
        import importlib

        module, _, name = self.place.partition(":")
        app: App = getattr(importlib.import_module(module), name or "app")
        return app


BENCH = "The bench"
ACQUISITION = "Acquisition"
RECONSTRUCTION = "Reconstruction"
ANALYSIS = "Calibration and analysis"
DISPLAY = "Holographic display"

COMMANDS: Mapping[str, Command] = {
    "demo": Command(BENCH, "the main job, start to end, on the simulated bench", "instrument.cli.demo"),
    "gui": Command(
        BENCH, "the desktop program: live view, stage, sweeps, results", "instrument.cli.bench:gui_app"
    ),
    "new": Command(
        BENCH, "write a commented bench.toml (simulated by default)", "instrument.cli.bench:new_app"
    ),
    "check": Command(
        BENCH, "open every device of the bench and report on it", "instrument.cli.bench:check_app"
    ),
    "drivers": Command(
        BENCH, "list the installed drivers by kind of device", "instrument.cli.bench:drivers_app"
    ),
    "devices": Command(
        BENCH,
        "list what is connected: USB, HID, serial, video, GenICam, displays",
        "instrument.cli.bench:devices_app",
    ),
    "calibrate": Command(
        BENCH, "measure PSFs, the sensor, the diffuser, or an SLM", "instrument.cli.calibrate"
    ),
    "snap": Command(BENCH, "take a photograph", "instrument.cli.capture:snap_app"),
    "plan": Command(ACQUISITION, "look at a plan before anything moves, or write one", "instrument.cli.plan"),
    "run": Command(ACQUISITION, "carry out a plan", "instrument.cli.acquire:run_app"),
    "resume": Command(ACQUISITION, "go on with a run that did not end", "instrument.cli.acquire:resume_app"),
    "record": Command(ACQUISITION, "record video at full camera rate", "instrument.cli.capture:record_app"),
    "list": Command(ACQUISITION, "list the runs in a folder", "instrument.cli.runs:list_app"),
    "show": Command(
        ACQUISITION, "say what is in a run; or show a hologram on the SLM", "instrument.cli.show"
    ),
    "verify": Command(
        ACQUISITION, "read every frame of a run and check it", "instrument.cli.runs:verify_app"
    ),
    "export": Command(
        ACQUISITION, "write a run's frames as TIFF, HDF5, NumPy, PNG, MP4", "instrument.cli.runs:export_app"
    ),
    "reconstruct": Command(
        RECONSTRUCTION, "reconstruct the scene from a PSF and a photograph", "instrument.cli.reconstruct"
    ),
    "activity": Command(
        RECONSTRUCTION, "fluorescence over time: dF/F, regions, traces", "instrument.cli.activity"
    ),
    "analyze": Command(
        ANALYSIS, "what a calibration's optics can do: one page and JSON", "instrument.cli.analyze"
    ),
    "compare": Command(ANALYSIS, "two calibrations: what moved, is a new one due", "instrument.cli.compare"),
    "chart": Command(ANALYSIS, "time and memory against error, for every method", "instrument.cli.chart"),
    "stability": Command(
        ANALYSIS, "map where methods fail, against pairs of stresses", "instrument.cli.stability"
    ),
    "refocus": Command(ANALYSIS, "bring a calibrated PSF to another depth", "instrument.cli.refocus"),
    "hologram": Command(
        DISPLAY, "compute the SLM phase that shows a picture through the mask", "instrument.cli.hologram"
    ),
    "align": Command(DISPLAY, "find the scattering mask and bring it to its place", "instrument.cli.align"),
    "table7.1": Command(
        DISPLAY,
        "the dissertation's comparison of methods, also without aliasing",
        "instrument.cli.table71",
    ),
    "etendue": Command(
        DISPLAY, "field of view, eyebox and resolution of a holographic display", "instrument.cli.etendue"
    ),
}
