"""A chart's picture has a dozen lines at most, named apart from each other, and what lies on the front."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

from instrument.evaluation.chart import ChartData, colours_of
from instrument.evaluation.chart_figure import MOST_LINES, chart_figure, chosen, draw_chart
from instrument.evaluation.figures import chart_page
from recon.evaluation.scored import KINDS, SECONDS, Point, pareto

SCORE = KINDS["reconstruction"].scores[0]


def _points(settings: int) -> tuple[Point, ...]:
    """Settings of four families, the later ones slower and, but for one in three, better."""
    return tuple(
        Point(
            f"solver{n % 4} convolution p{n}",
            count,
            1e-3 * (n + 1) * count,
            psnr_db=15 + 4 * np.log10(count) + n * (n % 3 > 0) / 4,
            peak_mib=1.0 + n,
            family=f"solver{n % 4} convolution",
        )
        for n in range(settings)
        for count in (3, 10, 30)
    )


def test_a_dozen_lines_hold_the_front_and_the_best_of_each_family() -> None:
    points = _points(40)
    runs = {
        name: [p for p in points if p.setting == name] for name in dict.fromkeys(p.setting for p in points)
    }
    front = pareto(points, SCORE)
    shown = chosen(runs, front, SCORE)
    assert len(shown) == MOST_LINES
    assert {runs[name][0].family for name in shown} == {p.family for p in points}
    best = max(points, key=lambda p: p.psnr_db).setting
    assert shown[0] == best
    few = chosen(dict(list(runs.items())[:5]), [], SCORE)
    assert len(few) == 5


def test_what_is_quick_is_named_where_many_are_nearly_the_best() -> None:
    quick = [Point(f"quick{n}", 1, 1e-3 * 2**n, psnr_db=20.0 + 3 * n, family="a") for n in range(4)]
    best = [Point(f"best{n}", 1, 1.0 + n, psnr_db=34.0 + n / 100, family="a") for n in range(20)]
    runs = {p.setting: [p] for p in (*quick, *best)}
    shown = chosen(runs, pareto([*quick, *best], SCORE), SCORE)
    assert len(shown) == MOST_LINES
    assert {p.setting for p in quick} < set(shown)
    assert shown[0] == "best19"


def test_names_stand_apart_beside_the_panel_and_say_what_the_front_costs() -> None:
    data = ChartData("reconstruction", {"simulated": True}, _points(40), {}, ())
    axes = Figure().subplots()
    shown = draw_chart(axes, data.points, SECONDS, SCORE, colours_of(data))
    names = list(axes.texts)
    assert len(names) == len(shown) == MOST_LINES
    heights = sorted(text.get_position()[1] for text in names)
    assert np.diff(heights).min() > 0.06
    assert not any("convolution" in text.get_text() for text in names)  # what all have in common is not said
    bold = [text.get_text() for text in names if text.get_fontweight() == "bold"]
    assert bold
    assert all(text.endswith(("ms", " s")) for text in bold)
    assert len(chart_figure(data).axes) == 2


def test_a_page_offers_the_axes_that_were_measured() -> None:
    bare = tuple(replace(p, peak_mib=np.nan) for p in _points(3))
    pages = [chart_page(ChartData("reconstruction", {}, points, {}, ())) for points in (_points(3), bare)]
    assert ["memory beyond" in page for page in pages] == [True, False]
    assert all("time of the solver" in page for page in pages)


def test_long_names_are_cut_by_no_edge_and_no_panel() -> None:
    long = tuple(replace(p, setting=f"{p.setting} tv-isotropic background bin 2 float64") for p in _points(9))
    short = tuple(replace(p, setting=f"{p.setting} other") for p in _points(3))
    figure = chart_figure(ChartData("reconstruction", {"simulated": True}, (*long, *short), {}, ()))
    figure.savefig(BytesIO())  # places the names
    left, right = figure.axes
    ends = [max(Text.get_window_extent(text).x1 for text in axes.texts) for axes in (left, right)]
    assert ends[0] < right.get_tightbbox(for_layout_only=True).x0  # type: ignore[union-attr]
    assert ends[1] < figure.bbox.x1


def test_a_long_title_ends_before_the_mark_of_what_is_simulated() -> None:
    about = {"simulated": True, "scene": "the photograph of the demo", "pixels": (270, 320)}
    points = tuple(replace(p, setting=p.setting[-2:], peak_mib=float("nan")) for p in _points(4))
    figure = chart_figure(ChartData("reconstruction", about, points, {}, ()))
    title = next(text for text in figure.texts if text.get_text().endswith("pixels"))
    mark = next(text for text in figure.texts if text.get_text() == "SIMULATED")
    assert title.get_window_extent().x1 < mark.get_window_extent().x0 - 10


def test_figures_of_costs_that_lie_close_stand_apart() -> None:
    points = tuple(
        replace(_points(1)[0], iterations=n, seconds=0.9 + 0.0004 * n, psnr_db=24.3 + 0.001 * n)
        for n in (5, 10, 20, 40)
    )
    figure = chart_figure(ChartData("reconstruction", {"simulated": True}, points, {}, ()))
    figure.savefig(BytesIO())
    for axes in figure.axes:
        low, high = axes.get_xlim()
        shown = [t for t in axes.get_xticklabels() if low <= t.get_position()[0] <= high]
        ends = sorted((Text.get_window_extent(t).x0, Text.get_window_extent(t).x1) for t in shown)
        assert len(ends) > 1
        assert all(later[0] - earlier[1] > earlier[1] - earlier[0] for earlier, later in pairwise(ends))
