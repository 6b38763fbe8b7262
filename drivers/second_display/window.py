"""The window over the whole output, drawn by Qt without scaling; lives in the GUI thread."""

from __future__ import annotations

import time
from collections.abc import Callable

from PySide6.QtCore import QEvent, QEventLoop, QPointF, QRect, QSize, Qt
from PySide6.QtGui import (
    QBackingStore,
    QExposeEvent,
    QGuiApplication,
    QImage,
    QPainter,
    QRegion,
    QScreen,
    QSurface,
    QWindow,
)

from drivers.errors import DeviceError
from drivers.second_display.outputs import Output, SecondDisplayOptions, choose
from drivers.second_display.x11 import Place, ScreenSaverInhibition, XConnection

_EXPOSE_S = 5.0


def outputs() -> tuple[Output, ...]:
    """Return all outputs of the desktop."""
    primary = QGuiApplication.primaryScreen()
    return tuple(
        _output(index, screen, screen is primary) for index, screen in enumerate(QGuiApplication.screens())
    )


def _output(index: int, screen: QScreen, primary: bool) -> Output:
    size = _native(screen.size(), screen.devicePixelRatio())
    return Output(
        index=index,
        name=screen.name(),
        manufacturer=screen.manufacturer(),
        model=screen.model(),
        serial_number=screen.serialNumber(),
        width=size.width(),
        height=size.height(),
        refresh_hz=screen.refreshRate(),
        depth=screen.depth(),
        primary=primary,
    )


def _native(size: QSize, ratio: float) -> QSize:
    """Return a size in the output's own pixels from one in a scaled desktop's."""
    return QSize(round(size.width() * ratio), round(size.height() * ratio))


class _Window(QWindow):
    """Covers a screen with an image, pixel by pixel; keys, clicks and requests to close do nothing."""

    def __init__(self, screen: QScreen, image: QImage) -> None:
        super().__init__(screen)
        self.image = image
        self.setSurfaceType(QSurface.SurfaceType.RasterSurface)
        flags = (
            Qt.WindowType.Window
            | Qt.WindowType.FramelessWindowHint
            | Qt.WindowType.WindowStaysOnTopHint
            | Qt.WindowType.WindowDoesNotAcceptFocus
        )
        if _x11():
            # Outside the window manager's rule: nothing to decorate, move, minimise, or send elsewhere.
            flags |= Qt.WindowType.X11BypassWindowManagerHint
        self.setFlags(flags)
        self.setCursor(Qt.CursorShape.BlankCursor)
        self.setGeometry(screen.geometry())
        self._store: QBackingStore | None = QBackingStore(self)

    def end(self) -> None:
        """Remove the window; its backing store must go first."""
        self._store = None
        self.destroy()
        self.deleteLater()

    def event(self, event: QEvent) -> bool:
        if event.type() == QEvent.Type.Close:
            event.ignore()
            return True
        return super().event(event)

    def exposeEvent(self, event: QExposeEvent) -> None:  # noqa: N802 - Qt's name
        if self.isExposed():
            self.paint()

    def paint(self) -> None:
        """Draw the image and wait until the display server has it."""
        store = self._store
        if store is None:  # removed meanwhile
            return
        whole = QRect(0, 0, self.width(), self.height())
        ratio = self.devicePixelRatio()
        store.resize(whole.size())
        store.beginPaint(QRegion(whole))
        painter = QPainter(store.paintDevice())
        painter.scale(1 / ratio, 1 / ratio)  # undo the desktop's scaling: one image pixel, one display pixel
        painter.setCompositionMode(QPainter.CompositionMode.CompositionMode_Source)
        painter.drawImage(QPointF(0, 0), self.image)
        painter.end()
        store.endPaint()
        store.flush(QRegion(whole))
        QGuiApplication.sync()


class PatternScreen:
    """One output covered by a window, with what happens to it.

    Parameters
    ----------
    device : str
        The device as error messages name it.
    on_lost : callable
        Called with the error, once, when the output is unplugged, switched off or changes its mode.
    """

    def __init__(self, device: str, on_lost: Callable[[DeviceError], None]) -> None:
        self._device = device
        self._on_lost = on_lost
        self._window: _Window | None = None
        self._screen: QScreen | None = None
        self._output: Output | None = None
        self._lost: DeviceError | None = None
        self._inhibition: ScreenSaverInhibition | None = None
        self._check = False
        self._x11: XConnection | None = None
        self._place: Place | None = None

    def open(self, options: SecondDisplayOptions) -> tuple[Output, str]:
        """Cover the output that is meant, blank.

        Returns
        -------
        Output
        str
            What keeps the screen saver off, in words.

        Raises DeviceError: see ``choose``; or when the window does not become visible.
        """
        output = choose(outputs(), options, self._device)
        screen = QGuiApplication.screens()[output.index]
        blank = QImage(output.width, output.height, QImage.Format.Format_Grayscale8)
        blank.fill(0)
        self._output, self._check = output, options.check_by_screenshot
        self._lost = None
        if _x11():
            self._x11 = XConnection.open()
            self._place = self._x11.place(output.name) if self._x11 is not None else None
            if self._place is not None and self._place[2:] != (output.width, output.height):
                self.close()
                raise DeviceError(
                    self._device,
                    f"{output.name} is {self._place.width} x {self._place.height}, but Qt still takes it for "
                    f"{output.width} x {output.height}.",
                    "It changed its mode since this program began: start the program again.",
                )
        app = _application()
        app.screenRemoved.connect(self._removed)
        screen.geometryChanged.connect(self._changed)
        self._screen = screen
        self._window = _Window(screen, blank)
        try:
            if not _x11():  # there the window's place and size are enough
                self._window.setWindowStates(Qt.WindowState.WindowFullScreen)
            self._window.setVisible(True)
            self._wait_until_exposed(self._window)
            self._inhibition = ScreenSaverInhibition()
        except DeviceError:
            self.close()
            raise
        return output, self._inhibition.by

    def show(self, levels: bytes | bytearray | memoryview) -> None:
        """Draw ``height * width`` bytes of grey levels; the display server has them when this returns.

        Raises DeviceError when the output is lost, the window is hidden, or (if so configured) the screenshot
        differs.
        """
        self._look_at_place()
        if self._lost is not None:
            raise self._lost
        window, output = self._window, self._output
        if window is None or output is None:
            raise DeviceError(self._device, "its window is closed.")
        # copy: the image would else refer to memory that the caller writes the next pattern to
        window.image = QImage(
            levels, output.width, output.height, output.width, QImage.Format.Format_Grayscale8
        ).copy()
        self._wait_until_exposed(window)
        if _x11():  # elsewhere a program cannot
            window.raise_()
        window.paint()
        if self._check:
            self._compare(window)
        self._look_at_place()
        if self._lost is not None:  # meanwhile
            raise self._lost

    def close(self) -> None:
        """Uncover the output; closing twice does nothing."""
        if self._x11 is not None:
            self._x11.close()
            self._x11 = None
        if self._inhibition is not None:
            self._inhibition.end()
            self._inhibition = None
        if self._screen is not None:
            _application().screenRemoved.disconnect(self._removed)
            if self._screen in QGuiApplication.screens():
                self._screen.geometryChanged.disconnect(self._changed)
            self._screen = None
        self._remove_window()

    def _wait_until_exposed(self, window: _Window) -> None:
        deadline_s = time.monotonic() + _EXPOSE_S
        while not window.isExposed() and self._lost is None:
            if time.monotonic() > deadline_s:
                raise DeviceError(
                    self._device,
                    f"its window did not become visible on {self._name()} within {_EXPOSE_S:g} s.",
                    "Is the session locked, or the output asleep?",
                )
            QGuiApplication.processEvents(QEventLoop.ProcessEventsFlag.ExcludeUserInputEvents, 20)
        if self._lost is not None:
            raise self._lost
        output = self._output
        size = _native(window.size(), window.devicePixelRatio())
        if output is not None and (size.width(), size.height()) != (output.width, output.height):
            raise DeviceError(
                self._device,
                f"its window is {size.width()} x {size.height()} pixels on {output}.",
                "The desktop scales this output or keeps a part of it: set its scale to 100 %.",
            )

    def _compare(self, window: _Window) -> None:
        screen = window.screen()
        place = screen.geometry()
        # X11's root window shows what lies over ours, too.
        grabbed = 0 if _x11() else window.winId()
        shot = screen.grabWindow(grabbed, 0, 0, place.width(), place.height()).toImage()
        if shot.isNull():
            raise DeviceError(
                self._device,
                "the desktop allows no screenshot to compare with.",
                "Use an X11 session, or set check_by_screenshot = false.",
            )
        shot.setDevicePixelRatio(1.0)
        if shot.convertToFormat(QImage.Format.Format_RGB32) != window.image.convertToFormat(
            QImage.Format.Format_RGB32
        ):
            raise DeviceError(
                self._device,
                f"a screenshot of {self._name()} differs from the pattern.",
                "Something covers it (a panel, a notification), or the desktop scales or colours it.",
            )

    # What happens to the output -------------------------------------------------------------------
    def _removed(self, screen: QScreen) -> None:
        if screen is self._screen:
            self._lose(
                f"output {self._name()} was unplugged or switched off.",
                "Connect it, switch it on, and open the SLM again.",
            )

    def _look_at_place(self) -> None:
        """Ask the X server whether the output is still where and what it was; see ``XConnection.place``."""
        place = self._x11.place(self._name()) if self._x11 is not None else None
        if self._place is None or place is None or place == self._place:
            return
        self._lose(
            f"output {self._name()} changed from {_words(self._place)} to {_words(place)}.",
            "Set the SLM's own resolution and open the SLM again.",
        )

    def _changed(self, geometry: QRect) -> None:
        screen, output = self._screen, self._output
        if screen is None or output is None:
            return
        size = _native(geometry.size(), screen.devicePixelRatio())
        if (size.width(), size.height()) != (output.width, output.height):
            self._lose(
                f"output {self._name()} changed from {output.width} x {output.height} to "
                f"{size.width()} x {size.height()} pixels.",
                "Set the SLM's own resolution and open the SLM again.",
            )
        elif self._window is not None:  # only its place on the desktop
            self._window.setGeometry(geometry)

    def _lose(self, problem: str, remedy: str) -> None:
        if self._lost is None:
            self._lost = DeviceError(self._device, problem, remedy)
            self._remove_window()  # at once: Qt would move it over the operator's screen
            self._on_lost(self._lost)

    def _remove_window(self) -> None:
        window, self._window = self._window, None
        if window is not None:
            window.end()

    def _name(self) -> str:
        return self._output.name if self._output is not None else "?"


def _words(place: Place) -> str:
    return f"{place.width} x {place.height} pixels at {place.x}, {place.y}"


def _x11() -> bool:
    return QGuiApplication.platformName() == "xcb"


def _application() -> QGuiApplication:
    app = QGuiApplication.instance()
    assert isinstance(app, QGuiApplication)
    return app
