"""A chart of cost against accuracy as a picture: a few lines named at their ends, and the front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from instrument.evaluation.chart import ChartData, colours_of, title_of
from instrument.files.figures import FAINT, INK, mark_simulated, style
from recon.evaluation.scored import MEMORY, SECONDS, Axis, Point, is_known, pareto

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import XAxis, YAxis
    from matplotlib.figure import Figure

MOST_LINES = 12
"""Settings drawn as lines and named; the others are faint points, and lines of the page."""
_LEAST = {"seconds": 1e-4, "peak_mib": 0.1}
"""Smaller ones are drawn here: what costs next to nothing has no place on a logarithmic axis."""
_NARROW = 3.0
"""Times the least value up to which an axis is linear, whatever it should be."""
_PANEL, _LEFT, _NAME_GAP = 4.9, 0.75, 0.22
"""Inches: of a panel, of its scale and words at the left, from it to the names at its right."""
_MARK = 2.2
"""Beside the title, inches: SIMULATED and what is free about it."""
_LINE_HEIGHT = 0.068
"""Of a name, in the height of a panel."""


def chart_figure(data: ChartData) -> Figure:
    """Draw a row of two panels for each group: a score against two costs; of holograms two scores."""
    from matplotlib.figure import Figure

    groups = list(dict.fromkeys(p.group for p in data.points))
    views, colours = _views(data), colours_of(data)
    figure = Figure(figsize=(8.6 * len(views), 1.2 + 4.6 * len(groups)), dpi=100, facecolor="white")
    grid = figure.subplots(len(groups), len(views), squeeze=False)
    for row, group in zip(grid, groups, strict=True):
        own = [p for p in data.points if p.group == group]
        for axes, (cost, score) in zip(row, views, strict=True):
            draw_chart(axes, own, cost, score, colours)
            axes.set_title(group, fontsize=11, loc="left", color=INK)
    top = 1 - 0.6 / figure.get_figheight()
    title = figure.text(
        0.02, (top + 1) / 2, title_of(data), fontsize=13, color=INK, weight="bold", va="center"
    )
    _make_room(figure, grid, top, title.get_window_extent().width / figure.dpi + _MARK)
    most = max(len({p.setting for p in data.points if p.group == group}) for group in groups)
    grey = "; grey: the other settings, by name in chart.html" if most > MOST_LINES else ""
    note = f"black: nothing is both cheaper and better; bold: on it, with its score and cost there{grey}"
    figure.text(0.02, top, note, fontsize=10, color=FAINT, va="center")
    if data.about.get("simulated"):
        mark_simulated(figure, (top + 1) / 2)
    return figure


def _make_room(figure: Figure, grid: npt.NDArray[np.object_], top: float, least: float) -> None:
    """Place the panels, each as wide as another, with room for the longest name beside each column.

    The figure becomes ``least`` inches wide or more.
    """
    from matplotlib.text import Text

    height = figure.get_figheight()
    names = [  # the text's own width: an annotation's takes its arrow in
        max(Text.get_window_extent(text).width for axes in column for text in axes.texts) / figure.dpi
        for column in grid.T
    ]
    lefts = np.cumsum([_LEFT, *(_PANEL + _NAME_GAP + name + _LEFT for name in names)])
    width = max(float(lefts[-1]) - _LEFT / 2, least)
    figure.set_figwidth(width)
    figure.subplots_adjust(
        hspace=0.3, top=top - 0.5 / height, bottom=0.6 / height, left=0.0, right=1.0, wspace=0.0
    )
    for column, left in zip(grid.T, lefts, strict=False):
        for axes in column:
            place = axes.get_position()
            axes.set_position((left / width, place.y0, _PANEL / width, place.height))


def _views(data: ChartData) -> list[tuple[Axis, Axis]]:
    """Return cost and score of each panel."""
    kind, score = data.kind, data.kind.score_of(data.points)
    if kind.name == "hologram":
        return [(kind.costs[0], score), (kind.costs[0], kind.scores[1])]
    return [(cost, score) for cost in kind.costs[:2] if any(is_known(p, cost.key) for p in data.points)]


def draw_chart(
    axes: Axes, points: Sequence[Point], cost: Axis, score: Axis, colours: Mapping[str, str]
) -> list[str]:
    """Draw one panel; return the settings drawn as lines, which are named at its right side, best first.

    On the front, in black, lies what nothing beats in both; of what lies on it names are bold, with a score.
    """
    known = [p for p in points if is_known(p, cost.key) and is_known(p, score.key)]
    front = pareto(known, score, cost)
    runs = {name: [p for p in known if p.setting == name] for name in dict.fromkeys(p.setting for p in known)}
    shown = chosen(runs, front, score)
    common = _common_words(runs)
    if cost is MEMORY:  # a run's peak is one number: of its points the best says all
        best = (pareto(run, score, cost)[-1:] for run in runs.values())
        runs = dict(zip(runs, best, strict=True))
    for name, run in runs.items():
        x, y = [_x(p, cost) for p in run], [float(getattr(p, score.key)) for p in run]
        if name in shown:
            axes.plot(x, y, "o-", ms=3, lw=1.5, color=colours[run[0].family], zorder=3)
        else:
            axes.plot(x, y, "o", ms=2.2, color=FAINT, alpha=0.3, zorder=1, mew=0)
    axes.plot(
        [_x(p, cost) for p in front],
        [float(getattr(p, score.key)) for p in front],
        drawstyle="steps-post",  # between two points of the front the cheaper one is all there is
        color="black",
        lw=1.6,
        zorder=4,
    )
    style(axes, "", cost.words, score.words)
    told = [p for name in shown for p in runs[name]] + front
    for axis, which, values in (
        (cost, axes.xaxis, [_x(p, cost) for p in told]),
        (score, axes.yaxis, [float(getattr(p, score.key)) for p in told]),
    ):
        _scale(which, values, logarithmic=axis.logarithmic)
    _name(axes, [(name, runs[name]) for name in shown], front, (cost, score), colours, common)
    return shown


def chosen(runs: Mapping[str, Sequence[Point]], front: Sequence[Point], score: Axis) -> list[str]:
    """Return at most MOST_LINES settings: the front's, each family's best, then the best of the rest.

    Of the front its ends come first, then those by which the score rises most along it: a dozen that are all
    but the best would say nothing about what is quick. They are returned the best first.
    """
    sign = 1.0 if score.more_is_better else -1.0
    best = {name: max(sign * float(getattr(p, score.key)) for p in run) for name, run in runs.items()}
    ranked = sorted(runs, key=lambda name: -best[name])
    rises: dict[str, float] = {}
    reached = -np.inf
    for point in front:
        value = sign * float(getattr(point, score.key))
        rises[point.setting] = rises.get(point.setting, 0.0) + value - reached
        reached = value
    on_front = sorted(rises, key=lambda name: (name != ranked[0], -rises[name]))  # the cheapest rose most
    firsts = list({runs[name][0].family: name for name in reversed(ranked)}.values())
    # A third for families, so that each method's best is there to be compared.
    wanted = [*on_front[: MOST_LINES - min(len(firsts), MOST_LINES // 3)], *sorted(firsts, key=ranked.index)]
    found = list(dict.fromkeys([*wanted, *on_front, *ranked]))[:MOST_LINES]
    return sorted(found, key=ranked.index)


def _name(
    axes: Axes,
    lines: Sequence[tuple[str, Sequence[Point]]],
    front: Sequence[Point],
    axis: tuple[Axis, Axis],
    colours: Mapping[str, str],
    common: frozenset[str],
) -> None:
    """Write the settings' names beside a panel, each at the height of its line's end, led to from there."""
    cost, score = axis
    to_axes = axes.transData + axes.transAxes.inverted()
    ends = []
    for name, run in lines:
        end = max(run, key=lambda p: _x(p, cost))
        x, y = to_axes.transform((_x(end, cost), float(getattr(end, score.key))))
        best = [p for p in front if p.setting == name][-1:]
        ends.append((float(y), float(x), name, run[0].family, best))
    ends.sort()
    heights = _apart([y for y, *_ in ends])
    for height, (y, x, name, family, best) in zip(heights, ends, strict=True):
        words = _telling(name, common)
        if best:
            words += f"  {float(getattr(best[0], score.key)):.3g}, {_in_words(_x(best[0], cost), cost)}"
        axes.annotate(
            words,
            (x, y),
            xytext=(1.0 + _NAME_GAP / _PANEL, height),
            xycoords="axes fraction",
            textcoords="axes fraction",
            color=colours[family],
            fontsize=9,
            weight="bold" if best else "normal",
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "lw": 0.6,
                "color": colours[family],
                "alpha": 0.5,
                "shrinkA": 1,
                "shrinkB": 1,
                "relpos": (0.0, 0.5),
            },
        )


def _apart(wanted: Sequence[float]) -> list[float]:
    """Return heights, ascending as ``wanted`` are, a line apart and else as near to those as can be."""
    step = min(_LINE_HEIGHT, 1.0 / max(len(wanted) - 1, 1))
    # Heights less their order's steps must ascend: pool neighbours that do not (isotonic regression).
    blocks: list[list[float]] = []
    for number, height in enumerate(wanted):
        blocks.append([height - number * step])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    most = 1.0 - (len(wanted) - 1) * step
    flat = [float(np.clip(np.mean(block), 0.0, max(most, 0.0))) for block in blocks for _ in block]
    return [base + number * step for number, base in enumerate(flat)]


def _telling(name: str, common: frozenset[str]) -> str:
    """Return a name without what all names say, but for what follows its last own word: "1% of the light"."""
    words = name.split(" ")
    last = max((n for n, word in enumerate(words) if word not in common), default=-1)
    return " ".join(word for n, word in enumerate(words) if n > last or word not in common)


def _common_words(names: Mapping[str, object]) -> frozenset[str]:
    """Return the words that all names have."""
    words = [set(name.split(" ")) for name in names]
    return frozenset(set.intersection(*words)) if len(words) > 1 else frozenset()


def _scale(axis: XAxis | YAxis, values: Sequence[float], *, logarithmic: bool) -> None:
    """Have an axis hold what is drawn as lines: faint points far off would press them together."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

    low, high = min(values), max(values)
    set_limits = axis.axes.set_xlim if axis.axis_name == "x" else axis.axes.set_ylim
    if not logarithmic or low <= 0 or high <= _NARROW * low:
        rim = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
        set_limits(low - rim, high + rim)
        if axis.axis_name == "x":  # words of many digits beside each other
            axis.set_major_locator(MaxNLocator(5))
        return

    rim = (high / low) ** 0.06
    (axis.axes.set_xscale if axis.axis_name == "x" else axis.axes.set_yscale)("log")
    set_limits(low / rim, high * rim)
    axis.set_major_locator(LogLocator(subs=(1.0,) if high > 300 * low else (1.0, 2.0, 5.0), numticks=20))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _in_words(value: float, cost: Axis) -> str:
    if cost is SECONDS and value < 0.1:
        return f"{_short(1e3 * value)} ms"
    photographs = "photograph" if value == 1 else "photographs"
    unit = {"seconds": "s", "peak_mib": "MiB", "images": photographs}[cost.key]
    return f"{_short(value)} {unit}"


def _short(value: float) -> str:
    """Two digits that count, whole numbers whole."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _x(point: Point, cost: Axis) -> float:
    return max(float(getattr(point, cost.key)), _LEAST.get(cost.key, 0.0))
