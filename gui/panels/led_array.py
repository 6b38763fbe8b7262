"""The LED array as it is built: click an LED, or choose a pattern; colour and brightness."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QGridLayout, QPushButton, QSlider, QWidget

from drivers.led_array import LedPattern, Rgb
from gui.forms.fields import Behaviour, NumberField
from gui.panel import DevicePanel, on_bench
from gui.theme import colours, luminance
from gui.widgets.building import after_rest, button, choice, fill, in_row, label
from gui.widgets.dialogues import elided
from gui.widgets.entry import NumberEdit
from gui.widgets.plots import plot_widget
from instrument.plan.patterns import shape_buttons
from recon.base.as_python import Imports, expression
from recon.base.declare import options_of, with_overrides

_REST_MS = 150
"""Rest of the brightness before it is sent: a slider that is pulled must not fill a queue."""
_COLOURS: dict[str, Rgb] = {"white": (1, 1, 1), "red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1)}
_DIMMEST = 70
"""Grey level of the faintest lit LED as drawn, so that it is seen to be lit."""


class LedPanel(DevicePanel):
    """Draws the array with its LEDs as they are lit, and lights them."""

    kind = "led_array"
    look_ms = 300

    @classmethod
    def prepare(cls) -> None:
        """Look for patterns that installed packages add: each has a button; import what draws the first."""
        shape_buttons()
        _spacing(np.eye(2))

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        session = self.session
        self.plot = plot_widget("x", "y", x_unit="mm", y_unit="mm", grid=False)
        self.plot.setAspectLocked(True)
        self.plot.hideButtons()
        for axis in ("bottom", "left"):  # an LED's place is in its tool tip
            self.plot.hideAxis(axis)
        self.plot.setMinimumHeight(110)
        self.plot.setToolTip("A click toggles an LED")
        self.plot.setAccessibleName("LEDs where they are; one is toggled by its number, too")
        self.spots: Any = pg.ScatterPlotItem(pxMode=False, pen=None)
        self.spots.sigClicked.connect(self._clicked)
        self.plot.addItem(self.spots)
        self._drawn: LedPattern | None = None
        self._dimmed: tuple[LedPattern, LedPattern] | None = None
        """The pattern that was dimmed last, and the one whose hues it has: faint levels keep no hue."""
        self._positions: Any = None
        yield
        self.now = label("–", selectable=True, wraps=True)
        self.colour = choice(_COLOURS, "Colour of the LEDs that are lit next")
        self.brightness = QSlider(Qt.Orientation.Horizontal)
        self.brightness.setRange(1, 255)
        self.brightness.setValue(255)
        self.brightness.setAccessibleName("Brightness")
        self.brightness.setToolTip("Brightness of the LEDs that are lit, and of those lit next: 1 to 255")
        self._rest = after_rest(self, _REST_MS, self.dim)
        session.stop_pressed.connect(self._rest.stop)  # what was pulled before STOP lights nothing after it
        self.brightness.valueChanged.connect(lambda _: self._rest.start())
        self.level = label("255")
        self.level.setMinimumWidth(28)
        self.brightness.valueChanged.connect(lambda value: self.level.setText(str(value)))
        self._shapes = shape_buttons()
        declared = next(o for shape in self._shapes.values() for o in options_of(shape) if o.name == "na")
        na = NumberField(declared, Behaviour())
        na.show(na.default)
        self.na = na.widget
        self.index = NumberEdit("", 0, minimum=0, integer=True, tip="Number of the LED to toggle")
        self.index.returnPressed.connect(self._toggle_typed)
        for field in (self.na, self.index):
            field.setFixedWidth(80)
            self.heed(field)
        tip = "Light or darken the LED of this number"
        self.toggle_button = button("Toggle LED", tip, self._toggle_typed)
        self.pattern_buttons: dict[str, QPushButton] = {}
        yield
        grid = QGridLayout()
        grid.setSpacing(4)
        tips = {
            "Off": "Every LED dark",
            "Source": "The LEDs of the point source ([source] in bench.toml)",
            **{words: shape.help for words, shape in self._shapes.items()},
        }
        for number, (words, tip) in enumerate(tips.items()):
            made = button(words, tip, lambda _=False, words=words: self.show_pattern(words))
            self.pattern_buttons[words] = made
            grid.addWidget(made, number // 4, number % 4)
        self._controls = QWidget()
        fill(self.body, self.now, (self.plot, 1), self._controls)
        yield
        fill(
            self._controls,
            in_row(self.colour, (self.brightness, 1), self.level, label(na.label), self.na),
            grid,
            in_row(label("LED"), self.index, self.toggle_button, None),
        )
        yield
        self.watch_device(self.now)

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that light the LEDs that are lit now."""
        imports = Imports()
        lit = expression(self._drawn or LedPattern("off"), imports, indent="    ")
        lines = [f"bench.led_array.set_pattern({lit})", 'input("Enter ends, and turns the light off. ")']
        return on_bench(self.session.config.path, lines, imports)

    def restyle(self) -> None:
        """Take over the theme's colours."""
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
        if leds is None or not self.is_ready:
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
        dark = min(now.window, now.text, key=luminance)  # light is seen on it in every theme
        self.plot.setBackground(dark)
        brushes = [
            _brush(lit[i]) if max(lit.get(i, (0, 0, 0))) > 0 else pg.mkBrush(dark) for i in range(len(places))
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

    def show_device(self, is_open: bool) -> None:
        """Let LEDs be lit, or not."""
        self._controls.setEnabled(is_open)
        if not is_open:
            self._drawn = None

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

        self.command(f"LED array: {name}", work)

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

        self.command(f"LED array: brightness {top}", work)

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

        self.command(f"LED {led}", work)

    def _clicked(self, _item: object, points: Any, _event: object) -> None:
        if len(points):
            self.toggle(int(points[0].data()))

    def _toggle_typed(self) -> None:
        if self.index.submit() and self.index.value is not None:
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
