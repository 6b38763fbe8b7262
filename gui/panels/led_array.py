"""The LED array as it is built: click an LED, or choose a pattern; colour and brightness."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt, QTimer
from PySide6.QtWidgets import (
    QComboBox,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSlider,
    QVBoxLayout,
    QWidget,
)

from drivers.led_array import LedPattern, Rgb
from gui.jobs import BusyError
from gui.panel import Panel
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.dialogues import elided
from gui.widgets.number_edit import NumberEdit
from gui.widgets.plot import plot_widget, restyle
from instrument.plan.patterns import shape_buttons
from recon.base.declare import with_overrides

_LOOK_MS = 300
_REST_MS = 150
"""Rest of the brightness before it is sent: a slider that is pulled must not fill a queue."""
_COLOURS: dict[str, Rgb] = {"white": (1, 1, 1), "red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1)}
_DIMMEST = 70
"""Grey level of the faintest lit LED as drawn, so that it is seen to be lit."""


class LedPanel(Panel):
    """Draws the array with its LEDs as they are lit, and lights them."""

    title = "LED array"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.plot = plot_widget("x", "y", x_unit="mm", y_unit="mm", grid=False)
        self.plot.setAspectLocked(True)
        self.plot.hideButtons()
        for axis in ("bottom", "left"):  # an LED's place is in its tool tip
            self.plot.hideAxis(axis)
        self.plot.setMinimumHeight(110)
        self.plot.setToolTip("A click toggles an LED")
        self.spots: Any = pg.ScatterPlotItem(pxMode=False, pen=None)
        self.spots.sigClicked.connect(self._clicked)
        self.plot.addItem(self.spots)
        self._drawn: LedPattern | None = None
        self._dimmed: tuple[LedPattern, LedPattern] | None = None
        """The pattern that was dimmed last, and the one whose hues it has: faint levels keep no hue."""
        self._positions: Any = None
        self.now = QLabel("–")
        self.now.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.colour = QComboBox()
        self.colour.addItems(list(_COLOURS))
        self.colour.setToolTip("Colour of the LEDs that are lit next")
        self.brightness = QSlider(Qt.Orientation.Horizontal)
        self.brightness.setRange(1, 255)
        self.brightness.setValue(255)
        self.brightness.setToolTip("Brightness of the LEDs that are lit, and of those lit next: 1 to 255")
        self._rest = QTimer(self)
        self._rest.setSingleShot(True)
        self._rest.setInterval(_REST_MS)
        self._rest.timeout.connect(self.dim)
        session.stop_pressed.connect(self._rest.stop)  # what was pulled before STOP lights nothing after it
        self.brightness.valueChanged.connect(lambda _: self._rest.start())
        self.level = QLabel("255")
        self.level.setMinimumWidth(28)
        self.brightness.valueChanged.connect(lambda value: self.level.setText(str(value)))
        self.na = NumberEdit("", 0.25, minimum=0.001, maximum=1.0, tip="Numerical aperture of the patterns")
        self.na.setFixedWidth(80)
        self.index = NumberEdit("", 0, minimum=0, integer=True, tip="Number of the LED to toggle")
        self.index.setFixedWidth(80)
        self.index.returnPressed.connect(self._toggle_typed)
        self.toggle_button = QPushButton("Toggle LED")
        self.toggle_button.setToolTip("Light or darken the LED of this number")
        self.toggle_button.clicked.connect(self._toggle_typed)
        for field in (self.na, self.index):
            field.refused.connect(lambda why: self.refused(None, why))
        self.pattern_buttons: dict[str, QPushButton] = {}
        grid = QGridLayout()
        grid.setSpacing(4)
        self._shapes = shape_buttons()
        tips = {
            "Off": "Every LED dark",
            "Source": "The LEDs of the point source ([source] in bench.toml)",
            **{words: shape.help for words, shape in self._shapes.items()},
        }
        for number, (words, tip) in enumerate(tips.items()):
            button = QPushButton(words)
            button.setToolTip(tip)
            button.clicked.connect(lambda _=False, words=words: self.show_pattern(words))
            self.pattern_buttons[words] = button
            grid.addWidget(button, number // 4, number % 4)
        top = QHBoxLayout()
        top.addWidget(self.colour)
        top.addWidget(self.brightness, 1)
        top.addWidget(self.level)
        top.addWidget(QLabel("NA"))
        top.addWidget(self.na)
        one = QHBoxLayout()
        one.addWidget(QLabel("LED"))
        one.addWidget(self.index)
        one.addWidget(self.toggle_button)
        one.addStretch(1)
        self._controls = QWidget()
        controls = QVBoxLayout(self._controls)
        controls.setContentsMargins(0, 0, 0, 0)
        controls.addLayout(top)
        controls.addLayout(grid)
        controls.addLayout(one)
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.now)
        layout.addWidget(self.plot, 1)
        layout.addWidget(self._controls)
        session.device_changed.connect(self._device_changed)
        self._timer = QTimer(self)
        self._timer.timeout.connect(self.look)
        self._timer.start(_LOOK_MS)
        self._device_changed("led_array")

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that light the LEDs that are lit now."""
        path = self.session.config.path
        pattern = self._drawn or LedPattern("off")
        return (
            "from drivers.led_array import LedPattern\n"
            "from instrument.bench.bench import open_bench\n\n"
            f"with open_bench({str(path) if path else None!r}) as bench:\n"
            f"    bench.led_array.set_pattern({pattern!r})\n"
            '    input("Enter ends, and turns the light off. ")\n'
        )

    def shutdown(self) -> None:
        """End the timers."""
        self._timer.stop()
        self._rest.stop()

    def theme_changed(self) -> None:
        """Take over the theme's colours."""
        restyle(self.plot)
        self._drawn = None

    @property
    def rgb(self) -> Rgb:
        """Levels of the LEDs that are lit next."""
        red, green, blue = (self.brightness.value() * on for on in _COLOURS[self.colour.currentText()])
        return (red, green, blue)

    # What is lit ---------------------------------------------------------------------------------
    def look(self) -> None:
        """Draw the pattern that the array confirmed last, whoever asked for it."""
        leds = self.session.bench.led_array
        if not self.isVisible() or leds is None or not self.session.is_open("led_array"):
            return
        pattern = leds.pattern
        if pattern is self._drawn or pattern == self._drawn:
            return
        if self._positions is None:
            self._positions = np.asarray(leds.led_positions_mm)
        self._draw(pattern)

    def _draw(self, pattern: LedPattern) -> None:
        self._drawn = pattern
        places = self._positions[:, :2]
        lit = dict(pattern.levels)
        now = colours()
        brushes = [
            _brush(lit[i]) if max(lit.get(i, (0, 0, 0))) > 0 else pg.mkBrush(now.field)
            for i in range(len(places))
        ]
        self.spots.setData(
            x=places[:, 0],
            y=places[:, 1],
            size=0.8 * _spacing(places),
            brush=brushes,
            pen=pg.mkPen(now.dim),
            data=np.arange(len(places)),
            hoverable=True,
            tip=lambda x, y, data: f"LED {data}: {x:.1f}, {y:.1f} mm",
        )
        n = sum(max(rgb) > 0 for _, rgb in pattern.levels)
        elided(self.now, f"{pattern.description}  ({n} of {len(places)} LEDs lit)")
        self.index.set_limits(0, len(places) - 1)

    def _device_changed(self, kind: str) -> None:
        if kind != "led_array":
            return
        is_open = self.session.is_open("led_array")
        self._controls.setEnabled(is_open)
        if not is_open:
            self._drawn = None
            state = self.session.state("led_array")
            has_one = "led_array" in self.session.kinds
            elided(self.now, state.text or state.condition if has_one else "This bench has no LED array.")

    # Lighting ------------------------------------------------------------------------------------
    def show_pattern(self, name: str) -> None:
        """Show a pattern by its button's words: ``"Off"``, ``"Source"``, or one of ``shape_buttons``."""
        leds, bench = self.session.bench.led_array, self.session.bench
        if leds is None:
            return
        shape, rgb = self._shapes.get(name), self.rgb
        if shape is not None and hasattr(shape, "na"):
            if not self.na.submit():  # not with the aperture of before
                return
            shape = with_overrides(shape, {"na": self.na.value or shape.na})
        self._rest.stop()  # the brightness that was pulled goes with the pattern

        def work(_: object) -> None:
            if shape is not None:
                leds.set_pattern(shape.on(leds, rgb))
            elif name == "Source":
                bench.source_on()
            else:
                leds.off()

        self._start(f"LED array: {name}", work)

    def dim(self) -> None:
        """Give the LEDs that are lit the chosen brightness, each in its colour; lights none that is dark."""
        leds, top = self.session.bench.led_array, self.brightness.value()
        if leds is None or not self.session.is_open("led_array") or leds.pattern.is_dark:
            return

        def work(_: object) -> None:
            now = leds.pattern
            hues = self._dimmed[1] if self._dimmed is not None and self._dimmed[0] == now else now
            lit = tuple((i, _of_brightness(rgb, top)) for i, rgb in hues.levels if max(rgb) > 0)
            if lit and lit != now.levels:
                what = hues.description.partition(" rgb ")[0].partition(" at ")[0]
                leds.set_pattern(LedPattern(f"{what} at {top} of 255", lit))
                self._dimmed = leds.pattern, hues

        self._start(f"LED array: brightness {top}", work)

    def toggle(self, led: int) -> None:
        """Light an LED in the chosen colour, or darken it."""
        leds, rgb = self.session.bench.led_array, self.rgb
        if leds is None:
            return

        def work(_: object) -> None:
            lit = {i: levels for i, levels in leds.pattern.levels if max(levels) > 0}
            if lit.pop(led, None) is None:
                lit[led] = rgb
            if lit:
                words = f"LED {', '.join(map(str, sorted(lit)))}" if len(lit) <= 8 else f"{len(lit)} LEDs"
                leds.set_pattern(LedPattern(words, tuple(sorted(lit.items()))))
            else:
                leds.off()

        self._start(f"LED {led}", work)

    def _start(self, title: str, work: Any) -> None:
        try:
            job = self.tells(self.session.device_job(title, work, {"led_array"}))
        except BusyError as error:
            self.refused(None, str(error))
            return
        job.succeeded.connect(self._shown)

    def _shown(self, _result: object) -> None:
        self.accepted()
        self.look()

    def _clicked(self, _item: object, points: Any, _event: object) -> None:
        if len(points):
            self.toggle(int(points[0].data()))

    def _toggle_typed(self) -> None:
        self.index.submit()
        if self.index.value is not None and not self.index.property("refused"):
            self.toggle(int(self.index.value))


def _of_brightness(rgb: Rgb, top: int) -> Rgb:
    """Return the same hue, its brightest channel at ``top``."""
    red, green, blue = (round(level * top / max(rgb)) for level in rgb)
    return (red, green, blue)


def _brush(rgb: Rgb) -> Any:
    """Return an LED's colour as drawn: its hue where the theme has hues, never too dark to be seen."""
    top = max(rgb)
    shown = _DIMMEST + (255 - _DIMMEST) * top / 255
    if colours().red_light_only:
        return pg.mkBrush(round(shown), 0, 0)
    return pg.mkBrush(*(round(shown * level / top) for level in rgb))


def _spacing(places: Any) -> float:
    """Return the distance of the nearest two LEDs."""
    from scipy.spatial import cKDTree

    if len(places) < 2:
        return 1.0
    distance, _ = cKDTree(places).query(places, k=2)
    nearest = distance[:, 1]
    return float(np.median(nearest[nearest > 0])) if (nearest > 0).any() else 1.0
