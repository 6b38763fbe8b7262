"""Panels are made a slice at a time: imported in a job, then built so that the window answers in between."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from functools import partial

from PySide6.QtCore import QObject, Qt, QTimer, Signal

from gui.jobs import JobContext, words_for
from gui.panel import Panel
from gui.panels import PANELS
from gui.session import BenchSession
from gui.theme import TURN, restyled
from gui.widgets.building import PanelPlace, label, text_view
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config, template

_SLICE_S = 0.008
"""Of the window's thread at once; a part that takes longer is the only one of its slice."""
PICTURE_MS = 3000
"""That panels at the side give the live view for its first picture, at most, before they are made."""
REST_MS = 1
"""Between two slices: what was made is laid out and painted, and clicks are taken, in turns of their own."""


def take_slice(parts: Iterator[object]) -> None:
    """Make parts for as long as a slice may take, or until one says that it ends here (`TURN`).

    Raises StopIteration after the last of them.
    """
    end_s = time.thread_time() + _SLICE_S
    while next(parts) is not TURN and time.thread_time() <= end_s:
        pass


class PanelMaker(QObject):
    """Makes the panels of a window when they are first asked for.

    Attributes
    ----------
    panels : dict
        Those that are made, by name.

    Signals
    -------
    made
        There is another panel.

    Parameters
    ----------
    session : BenchSession
    places : mapping
        Where each panel stands, by name; says meanwhile that it is being opened, or why it cannot be.
    """

    made = Signal()

    def __init__(self, session: BenchSession, places: Mapping[str, PanelPlace], parent: QObject) -> None:
        super().__init__(parent)
        self._session = session
        self._places = places
        self.panels: dict[str, Panel] = {}
        self._slices: dict[str, Generator[str | None, None, Panel]] = {}
        self._then: dict[str, list[Callable[[Panel], object]]] = {}
        """What is done with each panel that was asked for, once it is made."""
        self._later: list[str] | None = [] if "camera" in session.kinds else None
        """What waits for the live view's first picture; None: nothing does any more."""
        session.pictured.connect(self._ask_rest)

    def whole(self, name: str) -> Panel:
        """Return a panel, made now, or to its end, if it was not yet."""
        if name not in self.panels:
            slices = self._slices.pop(name, None) or PANELS[name].slices(self._session)
            try:
                while True:
                    next(slices)
            except StopIteration as made:
                self._finish(name, made.value)
            except Exception:
                self._then.pop(name, None)  # it may be asked for again
                raise
        return self.panels[name]

    def ask(self, name: str, then: Callable[[Panel], object] = lambda _: None) -> None:
        """Have a panel made in slices, if it was not yet, and then something done with it."""
        if name in self.panels:
            then(self.panels[name])
            return
        if name in self._then:
            self._then[name].append(then)
            return
        self._then[name] = [then]
        self._say_opening(name)
        job = self._session.jobs.watch(f"Opening {PANELS[name].title}", lambda _: PANELS[name].load())
        job.succeeded.connect(lambda _: self._begin(name))
        job.failed.connect(lambda why: self._failed(name, why))
        job.cancelled.connect(lambda why: self._failed(name, why))  # as Ctrl-C does, wherever it comes from

    def waits_for(self, name: str) -> str:
        """Return what the opening of a panel waits for, in words; empty where it stands."""
        if name in self.panels:
            return ""
        if name in self._slices:
            return "its next slice"
        if name in self._then:
            return "the job that imports it"
        return "the live view's first picture" if name in (self._later or ()) else "nothing: see the log"

    def ask_later(self, name: str) -> None:
        """Have a panel made that stands beside the live view, whose first picture comes before it."""
        if self._later is None:
            self.ask(name)
            return
        if not self._later:
            QTimer.singleShot(PICTURE_MS, self, self._ask_rest)
        self._later.append(name)
        if name not in self.panels and name not in self._then:
            self._say_opening(name)

    def _ask_rest(self) -> None:
        names, self._later = self._later or [], None
        for name in names:
            self.ask(name)

    def _say_opening(self, name: str) -> None:
        waits = label("Opening …", "dim")
        waits.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self._places[name].hold(waits)

    def prepare(self) -> None:
        """Import and compile in a job what the panels need, before they are asked for."""

        def work(context: JobContext) -> None:
            if not self._session.kinds:  # from the start page a simulated bench is tried next
                Bench(parse_config(template(), None))
            for entry in PANELS.values():
                context.check()
                with contextlib.suppress(Exception):  # the panel says so when it is asked for
                    entry.load()

        if not self._session.is_closing:
            self._session.jobs.watch("Preparing panels", work)

    def shutdown(self) -> None:
        """Make none further; the timers of those that are half made end."""
        while self._slices:
            self._slices.popitem()[1].close()

    def _begin(self, name: str) -> None:
        if name not in self.panels:
            self._slices[name] = PANELS[name].slices(self._session)
            QTimer.singleShot(REST_MS, self, partial(self._go_on, name))  # the job's news took its turn

    def _go_on(self, name: str) -> None:
        """Make parts for as long as a slice may take; one that fails says why in the panel's place."""
        slices = self._slices.get(name)
        if slices is None or self._session.is_closing:
            return  # made at once meanwhile, or not wanted any more
        try:
            take_slice(slices)
            QTimer.singleShot(REST_MS, self, partial(self._go_on, name))
        except StopIteration as made:
            self._finish(name, made.value)
        except Exception as error:  # noqa: BLE001 - a panel's failure must not end the window
            self._failed(name, words_for(error))

    def _finish(self, name: str, panel: Panel) -> None:
        self._slices.pop(name, None)
        self.panels[name] = panel
        for _ in restyled(panel):  # where the theme was changed meanwhile
            pass
        self._places[name].hold(panel)
        self.made.emit()
        for then in self._then.pop(name, ()):
            then(panel)

    def _failed(self, name: str, why: str) -> None:
        self._slices.pop(name, None)
        self._then.pop(name, None)  # it may be asked for again
        if name not in self.panels and not self._session.is_closing:
            self._session.log("error", f"{PANELS[name].title}: {why}")
            self._places[name].hold(text_view(why))
