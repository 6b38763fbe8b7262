"""The window: panels around a STOP button that is always in reach."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import ExitStack
from functools import partial
from typing import cast

from PySide6.QtCore import QEvent, QObject, QSettings, QSize, Qt, QTimer
from PySide6.QtGui import QAction, QCloseEvent, QGuiApplication, QKeyEvent, QKeySequence, QShortcut, QWindow
from PySide6.QtWidgets import (
    QAbstractButton,
    QApplication,
    QDockWidget,
    QMainWindow,
    QMenu,
    QMenuBar,
    QMessageBox,
    QSizePolicy,
    QWidget,
)

from gui.dock_title import DockTitle
from gui.help import help_of
from gui.making import PICTURE_MS, REST_MS, PanelMaker, take_slice
from gui.panel import Panel
from gui.panels import PANELS
from gui.panels.unserved import UnservedPanel
from gui.session import BenchSession
from gui.session_news import OperatorRequest, name_of
from gui.theme import change_theme
from gui.widgets.building import PanelPlace, button, fill, in_row, label, tabs
from gui.widgets.device_chips import DeviceChips
from gui.widgets.dialogues import Question, TextWindow
from gui.widgets.entry import NumberEdit
from gui.widgets.status_line import StatusLine
from gui.widgets.step_strip import StepStrip
from gui.widgets.tab_order import Kept, stops_of
from instrument.bench.config import BenchConfig, Kind

_AREAS = {
    "top right": Qt.DockWidgetArea.RightDockWidgetArea,
    "right": Qt.DockWidgetArea.RightDockWidgetArea,
    "bottom": Qt.DockWidgetArea.BottomDockWidgetArea,
}


_SIZE = QSize(1600, 980)
_ROOMY = QSize(1500, 860)
"""From here on the log and the panels at the right stand side by side with the live view."""

_COMPACT_PX = 480
"""Width of the panels at the right of a small screen."""
_BY_HAND, _BREAKS_OFF = QMessageBox.Icon.Information, QMessageBox.Icon.Warning


class MainWindow(QMainWindow):
    """All panels, the devices' states, the running job, the log, and STOP.

    Parameters
    ----------
    session : BenchSession
        Not yet open; the caller opens it.
    settings : QSettings
        Where the window's layout is kept.
    room : QSize, optional
        What the screen has for windows; on a small one there are fewer panels side by side at first.
    """

    def __init__(self, session: BenchSession, settings: QSettings, room: QSize | None = None) -> None:
        super().__init__()
        size = _SIZE if room is None else _SIZE.boundedTo(room)
        self._compact = size.width() < _ROOMY.width() or size.height() < _ROOMY.height()
        self.session = session
        self._settings = settings
        self._places: dict[str, PanelPlace] = {}
        self.maker = PanelMaker(session, self._places, self)
        self._panels = self.maker.panels
        self._docks: dict[str, QDockWidget] = {}
        self._titles: dict[str, DockTitle] = {}
        self._restyling: Generator[str | None] | None = None
        self._kept = Kept(self)
        self._may_close = False
        self.question: Question | None = None
        """The question that was asked last, while it is open."""
        self._closing_question: Question | None = None
        self.next_bench: BenchConfig | None = None
        """What is to be opened once this bench is closed."""
        self.setWindowTitle(f"diffuserbench – {session.config.label}")
        self.setDockOptions(
            QMainWindow.DockOption.AllowTabbedDocks
            | QMainWindow.DockOption.AllowNestedDocks
            | QMainWindow.DockOption.AnimatedDocks
        )
        self.tabs = tabs({})
        self.setCentralWidget(self.tabs)
        self._make_top_bar()
        self.status = StatusLine(session, self)
        self.setStatusBar(self.status)
        self._make_panels()
        self._make_menus()
        self._make_stop_keys()
        session.device_changed.connect(self._show_simulated)
        session.asked.connect(self._ask_operator)
        session.handed_on.connect(self._hand_on)
        session.bench_wanted.connect(self.change_bench)
        session.closed.connect(self._close_now)
        session.opened.connect(
            lambda: QTimer.singleShot(PICTURE_MS if session.kinds else 0, self, self.maker.prepare)
        )
        self.resize(size)
        self._restore_layout()
        self._show_simulated()
        self.panel("log")  # from the first line on
        self.tabs.currentChanged.connect(self._fill_current)
        self.tabs.currentChanged.connect(self.status.leave_panel)
        if session.kinds:
            self._fill_current()
        else:  # with the keyboard in it: Return does what comes first
            self.bring("start")

    def change_bench(self, config: BenchConfig) -> None:
        """Close this bench, after asking where something runs, so that another is opened in its place."""
        self.next_bench = config
        self.close()

    # Panels --------------------------------------------------------------------------------------
    def _hand_on(self, name: str, what: object) -> None:
        """Show a panel, and have it work with what another one hands on; empty: nothing."""
        self.bring(name, lambda panel: panel.take(what) if what else None)

    def _take_step(self, panel: str, what: object) -> None:
        """Go where the next step is taken."""
        if panel == "reconnect":
            for kind in cast(tuple[Kind, ...], what):
                self.session.reconnect(kind)
        else:
            self._hand_on(panel, what)

    def panel(self, name: str) -> Panel:
        """Return a panel of the table, made now if it was not yet."""
        return self.maker.whole(name)

    def show_panel(self, name: str) -> Panel:
        """Bring a panel to the front, with the keyboard in it, and return it, made now if it was not yet."""
        panel = self.panel(name)
        self.bring(name)
        return panel

    def bring(self, name: str, then: Callable[[Panel], object] = lambda _: None) -> None:
        """Bring a panel to the front, with the keyboard in it; then do something with it, once it is made."""
        if name in self._docks:
            self._docks[name].show()
            self._docks[name].raise_()
        else:
            self.tabs.setCurrentWidget(self._places[name])

        def shown(panel: Panel) -> None:
            panel.setFocus(Qt.FocusReason.ShortcutFocusReason)
            then(panel)

        self.maker.ask(name, shown)

    def _make_panels(self) -> None:
        first: dict[str, QDockWidget] = {}
        for name, entry in PANELS.items():
            place = PanelPlace()
            self._places[name] = place
            if entry.area == "centre":
                index = self.tabs.addTab(place, entry.title)
                self.tabs.setTabToolTip(index, f"{entry.tip} ({entry.shortcut})")
                continue
            dock = QDockWidget(entry.title)
            dock.setObjectName(f"dock-{name}")
            dock.setWidget(place)
            dock.setToolTip(entry.tip)
            self._titles[name] = DockTitle(dock)
            dock.setTitleBarWidget(self._titles[name])
            self.addDockWidget(_AREAS[entry.area], dock)
            if entry.area in first:
                self.tabifyDockWidget(first[entry.area], dock)
            else:
                first[entry.area] = dock
            dock.visibilityChanged.connect(partial(self._dock_seen, name))
            self._docks[name] = dock
        if self.session.kinds:  # else the start page
            self.tabs.setCurrentWidget(self._places["live"])
        for dock in first.values():
            dock.raise_()
        if not self.session.kinds:
            for dock in self._docks.values():
                dock.hide()
        if self._compact:
            for area in ("top right", "bottom"):
                self.tabifyDockWidget(first["right"], first[area])
            first["top right"].raise_()
            self.resizeDocks([first["right"]], [_COMPACT_PX], Qt.Orientation.Horizontal)
            return
        self.setCorner(Qt.Corner.BottomRightCorner, Qt.DockWidgetArea.RightDockWidgetArea)
        if "top right" in first and "right" in first:
            self.resizeDocks([first["top right"], first["right"]], [430, 430], Qt.Orientation.Vertical)
            self.resizeDocks([first["top right"]], [500], Qt.Orientation.Horizontal)
        if "bottom" in first:
            self.resizeDocks([first["bottom"]], [150], Qt.Orientation.Vertical)

    def _dock_seen(self, name: str, visible: bool) -> None:
        self._places[name].set_seen(visible)
        self._titles[name].set_seen(visible)
        if visible:
            self.maker.ask_later(name)

    def _fill_current(self, _index: int = 0) -> None:
        place = self.tabs.currentWidget()
        for name, widget in self._places.items():
            if widget is place:
                self.maker.ask(name)

    # Bars and menus ------------------------------------------------------------------------------
    def _make_top_bar(self) -> None:
        """Make the menus, devices and STOP: one row that nothing can push STOP out of; the strip below it."""
        self.menus = QMenuBar()
        self.menus.setNativeMenuBar(False)
        self.menus.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)
        self.simulated = label("SIMULATED")
        self.simulated.setObjectName("simulated")
        self.simulated.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)
        self.simulated.setToolTip("Some or all devices of this bench have no hardware behind them")
        self.chips = DeviceChips(self.session)
        tip = "Halt all motion, turn the light off, end what runs (Esc)"
        self.stop_button = button("STOP", tip, self.session.stop)
        self.stop_button.setObjectName("stop")
        self.stop_button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.strip = StepStrip(self.session)
        self.strip.wanted.connect(self._take_step)
        first = in_row(self.menus, 12, self.simulated, self.chips, None, self.stop_button, spacing=4)
        first.setContentsMargins(0, 4, 8, 0)
        self._header = fill(QWidget(), first, self.strip, spacing=0)
        self._header.setObjectName("header")
        self.setMenuWidget(self._header)

    def _make_menus(self) -> None:
        view = self.menus.addMenu("&View")
        for name, entry in PANELS.items():
            action = self._add_action(view, entry.title, entry.shortcut, partial(self.bring, name))
            action.setToolTip(entry.tip)
        theme = self.menus.addMenu("&Theme")
        for number, (name, words) in enumerate(
            (("dark", "&Dark"), ("red", "&Red, for the dark room"), ("light", "&Light"))
        ):
            self._add_action(theme, words, f"Ctrl+Shift+{number + 1}", partial(self.set_theme, name))
        camera = self.menus.addMenu("&Camera")
        for words, keys, what in (
            ("&Live view, or hold the last frame", "Ctrl+L", "toggle_live"),
            ("Take a &photograph", "Ctrl+K", "snap"),
            ("&Record, or end the recording", "Ctrl+R", "record"),
        ):
            self._add_action(camera, words, keys, partial(self._on_live_panel, what))
        bench = self.menus.addMenu("&Bench")
        self._add_action(bench, "&Another bench…", "Ctrl+O", partial(self.bring, "start"))
        self._add_action(bench, "The &next step, as the strip says", "Ctrl+Shift+Return", self.strip.go_on)
        for kind in self.session.kinds:
            reconnect = partial(self.session.reconnect, kind)
            self._add_action(bench, f"Reconnect the {name_of(kind)}", "", reconnect)
        bench.addSeparator()
        self._add_action(bench, "&Quit", "Ctrl+Q", self.close)
        about = self.menus.addMenu("&Help")
        self._add_action(about, "&This panel, and all keys", "F1", self.show_help)

    def show_help(self) -> TextWindow:
        """Show what the panel that has the keyboard is for, and every key."""
        focused = QApplication.focusWidget()
        current = self.tabs.currentWidget()
        shown = [name for name, panel in self._panels.items() if focused and panel.isAncestorOf(focused)]
        shown += [name for name, place in self._places.items() if place is current and name in self._panels]
        name = next(iter(shown), "start")
        actions = [action for menu in self.menus.actions() for action in menu.menu().actions()]  # type: ignore[attr-defined]
        window = TextWindow("Help", help_of(name, self.panel(name), focused, actions), self)
        window.show()
        return window

    def _add_action(self, menu: QMenu, words: str, keys: str, call: Callable[[], object]) -> QAction:
        action = QAction(words, self)
        action.setShortcut(QKeySequence(keys))
        action.triggered.connect(lambda: call())
        menu.addAction(action)
        return action

    def _on_live_panel(self, what: str) -> None:
        """Do what the live view offers, whatever panel is in front, with what is being typed there."""
        self.maker.ask("live", lambda panel: self._do_on(panel, what))

    def _do_on(self, panel: Panel, what: str) -> None:
        typed = QApplication.focusWidget()
        ends = what == "record" and getattr(panel, "is_recording", False)  # no number keeps it from ending
        if not ends and isinstance(typed, NumberEdit) and panel.isAncestorOf(typed) and not typed.submit():
            return  # refused where it stands
        if isinstance(panel, UnservedPanel):
            self.bring("live")  # it says why
        else:
            getattr(panel, what)()

    def set_theme(self, name: str) -> None:
        """Change the looks of the whole program, a slice at a time, and remember it."""
        self._settings.setValue("theme", name)
        wholes: list[QWidget] = [self._header, self.statusBar()]
        for content in (place.content for place in self._places.values() if place.content is not None):
            wholes += content.wholes() if isinstance(content, Panel) else [content]
        if self._restyling is not None:
            self._restyling.close()
        self._restyling = change_theme(name, self, wholes)
        self._restyle(self._restyling)

    @property
    def is_restyling(self) -> bool:
        """Whether parts of the window still have the looks of the theme before."""
        return self._restyling is not None

    def _restyle(self, parts: Generator[str | None]) -> None:
        if parts is not self._restyling:
            return  # another theme was chosen meanwhile
        try:
            take_slice(parts)
            QTimer.singleShot(REST_MS, self, partial(self._restyle, parts))
        except StopIteration:
            self._restyling = None

    # STOP ----------------------------------------------------------------------------------------
    def _make_stop_keys(self) -> None:
        shortcut = QShortcut(QKeySequence(Qt.Key.Key_Escape), self)
        shortcut.setContext(Qt.ShortcutContext.ApplicationShortcut)
        shortcut.activated.connect(self.session.stop)
        # Dialogs and menus take Escape for themselves: there it is seen at the door.
        app = QGuiApplication.instance()
        assert isinstance(app, QGuiApplication)
        app.focusWindowChanged.connect(self._watch_window)

    def _watch_window(self, window: QWindow | None) -> None:
        if window is not None and window is not self.windowHandle():
            window.removeEventFilter(self)
            window.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        """Stop when Escape is pressed in a dialog or menu, which then closes as usual."""
        if (
            event.type() == QEvent.Type.KeyPress
            and isinstance(event, QKeyEvent)
            and event.key() == Qt.Key.Key_Escape
        ):
            self.session.stop()
        return False

    def focusNextPrevChild(self, forward: bool) -> bool:  # noqa: N802 - Qt's name
        """Go on by Tab from stop to stop.

        Qt's own way stops at parts that hand the keyboard on to another as well, wherever they are in its
        order: it went round within a panel, and never came to STOP. And it goes on from a part that is put
        off or hidden while it works, to a field that takes what is typed then: the keyboard waits until it is
        there again, and Tab goes on from where it stood.
        """
        stops, now = list(stops_of(self)), QApplication.focusWidget()
        if now is not None and not self._kept.takes(now):
            self._kept.keep(now)
            now.clearFocus()
            return False
        if now in stops:
            to: QWidget | None = stops[(stops.index(now) + (1 if forward else -1)) % len(stops)]
        else:
            to = None if now is not None else self._kept.neighbour(stops, forward=forward)
        if to is None:
            return super().focusNextPrevChild(forward)
        to.setFocus(Qt.FocusReason.TabFocusReason if forward else Qt.FocusReason.BacktabFocusReason)
        return True

    def keyPressEvent(self, event: QKeyEvent) -> None:  # noqa: N802 - Qt's name
        """Have Return press the button that has the keyboard: on some desktops only the space bar does."""
        now = QApplication.focusWidget()
        is_return = event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter) and not event.isAutoRepeat()
        held = event.modifiers() & ~Qt.KeyboardModifier.KeypadModifier
        if is_return and not held and isinstance(now, QAbstractButton):
            now.click()
        else:
            super().keyPressEvent(event)

    # What runs -----------------------------------------------------------------------------------
    def _show_simulated(self, _kind: str = "") -> None:
        simulated = [name_of(k) for k in self.session.kinds if self.session.state(k).simulated]
        self.simulated.setVisible(bool(simulated))
        everything = len(simulated) == len(self.session.kinds)
        self.simulated.setText("SIMULATED" if everything else f"SIMULATED: {', '.join(simulated)}")

    def _ask_operator(self, request: OperatorRequest) -> None:
        answers = ("Done", "Stop")
        box = self._ask(_BY_HAND, "To be done by hand", request.text, answers, request.answer)
        request.withdrawn = box.reject

    def _ask(
        self,
        icon: QMessageBox.Icon,
        title: str,
        text: str,
        answers: tuple[str, str],
        answered: Callable[[bool], object],
    ) -> Question:
        self.question = box = Question(self, title, text, answers, answered, icon)
        box.finished.connect(lambda _: self._answered(box))
        box.ask()
        return box

    def _answered(self, box: Question) -> None:
        if self.question is box:  # not where another was asked meanwhile
            self.question = None

    # The end -------------------------------------------------------------------------------------
    def closeEvent(self, event: QCloseEvent) -> None:  # noqa: N802 - Qt's name
        """Close the bench first, and ask before anything that runs is broken off."""
        if self._may_close:
            self._keep_layout()
            event.accept()
            return
        event.ignore()
        running = [job.title for job in self.status.jobs]
        if running and self._closing_question is not None:
            self._closing_question.ask()
        elif running:
            text = f"{', '.join(running)} is running. Stop it and close?\nWhat was acquired is kept."
            answers = ("Stop and close", "Go on")
            self._closing_question = self._ask(_BREAKS_OFF, "Close?", text, answers, self._close_answered)
        else:
            self._end()

    def _close_answered(self, agreed: bool) -> None:
        self._closing_question = None
        if agreed:
            self._end()
        else:
            self.next_bench = None

    def _end(self) -> None:
        self.status.words.setText("Closing: light off, motion stopped …")
        with ExitStack() as each:  # one that fails keeps neither the others nor the bench from their end
            each.callback(self.session.close)
            each.callback(self.maker.shutdown)
            for panel in self._panels.values():
                each.callback(panel.shutdown)

    def _close_now(self) -> None:
        self._may_close = True
        self.close()

    def _keep_layout(self) -> None:
        if not self.session.kinds:
            return  # a page to start from is no layout for a bench
        self._settings.setValue("docks", sorted(self._docks))
        self._settings.setValue("geometry", self.saveGeometry())
        self._settings.setValue("state", self.saveState())
        self._settings.sync()

    def _restore_layout(self) -> None:
        if not self.session.kinds or self._settings.value("docks") != sorted(self._docks):
            return  # kept by a program with other panels: their docks would land anywhere
        geometry, state = self._settings.value("geometry"), self._settings.value("state")
        if geometry is not None:
            self.restoreGeometry(geometry)
        if state is not None:
            self.restoreState(state)
