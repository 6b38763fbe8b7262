"""The table of panels: a new panel is a module and one row here; it is imported when it is first shown."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from importlib import import_module
from typing import Literal, NamedTuple

from PySide6.QtWidgets import QWidget
from shiboken6 import isValid

from gui.panel import Panel
from gui.panels.unserved import UnservedPanel, why_not
from gui.session import BenchSession
from gui.theme import TURN, dress
from gui.widgets.tab_order import tab_in_order

Area = Literal["centre", "top right", "right", "bottom"]


class PanelEntry(NamedTuple):
    """A row of the table."""

    title: str
    """On its tab."""
    place: str
    """``module:class``."""
    area: Area
    """``"centre"``: a tab of its own size; the others are docks."""
    shortcut: str
    """Keys that bring it to the front."""
    tip: str
    needs: tuple[str, ...] = ()
    """Kinds of devices without which it can do nothing."""
    tried_on: str = ""
    """Of simulated benches the only one that serves it, of ``instrument.bench.config_file.TEMPLATES``."""

    @property
    def kind(self) -> type[Panel]:
        """The panel's class, imported if it was not yet."""
        module, _, name = self.place.partition(":")
        found: type[Panel] = getattr(import_module(module), name)
        return found

    def load(self) -> None:
        """Import and compile all that the panel needs; in any thread."""
        self.kind.prepare()

    def slices(self, session: BenchSession) -> Generator[str | None, None, Panel]:
        """Make the panel, with a ``yield`` after each of its parts, and return it."""
        panel: Panel
        if why := why_not(session, self.title, self.needs, self.tried_on):
            panel = UnservedPanel(session, self.title, why, self.tried_on)
        else:
            panel = self.kind(session)
        panel.title = self.title
        dress(panel)
        try:
            yield None
            yield from panel.parts()
            tab_in_order(panel)
            yield None
            parts = panel.findChildren(QWidget)
            for part in parts:  # what showing it first would do in one go
                part.ensurePolished()
                yield None
            for part in reversed(parts):  # layouts have measured fields that had not their looks yet
                part.updateGeometry()
            yield TURN  # to take its place is the work of a turn
        except BaseException:  # or not wanted any more
            if isValid(panel):  # its window may be gone
                Panel.shutdown(panel)  # its timers: a subclass may lack yet what it would end
            raise
        return panel


_CAMERA = ("camera",)
PANELS: Mapping[str, PanelEntry] = {
    "start": PanelEntry(
        "Start",
        "gui.panels.start:StartPanel",
        "centre",
        "Alt+Home",
        "Try a simulated bench, open yours, or work with files",
    ),
    "live": PanelEntry(
        "Live view", "gui.panels.live:LivePanel", "centre", "Ctrl+1", "The camera, running", _CAMERA
    ),
    "sweeps": PanelEntry(
        "Sweeps",
        "gui.panels.sweeps:SweepsPanel",
        "centre",
        "Ctrl+4",
        "Calibration routines and plans: plan, carry out, judge",
        _CAMERA,
    ),
    "runs": PanelEntry(
        "Runs", "gui.panels.runs:RunsPanel", "centre", "Ctrl+5", "Past runs: look at them, or go on"
    ),
    "alignment": PanelEntry(
        "Alignment",
        "gui.panels.alignment:AlignmentPanel",
        "centre",
        "Ctrl+Shift+A",
        "Find the scattering mask and bring it to its place",
        ("camera", "slm"),
        "display",
    ),
    "reconstructions": PanelEntry(
        "Reconstructions",
        "gui.panels.reconstructions:ReconstructionsPanel",
        "centre",
        "Ctrl+6",
        "Pictures and volumes: look, reconstruct, export",
    ),
    "holograms": PanelEntry(
        "Holograms",
        "gui.panels.holograms:HologramsPanel",
        "centre",
        "Ctrl+Shift+H",
        "Compute a hologram, show it, photograph it",
    ),
    "films": PanelEntry(
        "Films",
        "gui.panels.films:FilmsPanel",
        "centre",
        "Ctrl+Shift+V",
        "A recording or a reconstructed video: play it, follow regions, export",
    ),
    "tasks": PanelEntry(
        "Files",
        "gui.panels.tasks:TasksPanel",
        "centre",
        "Ctrl+Shift+F",
        "All that is done with files: verify, export, analyse, compare, videos, activity, charts, maps",
    ),
    "charts": PanelEntry(
        "Charts", "gui.panels.charts:ChartsPanel", "centre", "Ctrl+Shift+C", "Where methods fail"
    ),
    "live_reconstruction": PanelEntry(
        "Live reconstruction",
        "gui.panels.live_reconstruction:LiveReconstructionPanel",
        "top right",
        "Ctrl+2",
        "What the newest frame shows, with its latency",
        _CAMERA,
    ),
    "stage": PanelEntry(
        "Stage", "gui.panels.stage:StagePanel", "right", "Ctrl+7", "Position, targets, jog, home", ("stage",)
    ),
    "led_array": PanelEntry(
        "LED array",
        "gui.panels.led_array:LedPanel",
        "right",
        "Ctrl+8",
        "Which LEDs are lit",
        ("led_array",),
    ),
    "slm": PanelEntry("SLM", "gui.panels.slm:SlmPanel", "right", "Ctrl+9", "What is on the SLM", ("slm",)),
    "log": PanelEntry("Log", "gui.panels.log:LogPanel", "bottom", "Ctrl+0", "What happened, with filters"),
}
