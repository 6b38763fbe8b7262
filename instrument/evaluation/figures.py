"""A chart of cost against accuracy as a page that answers the mouse, and all its files; a map's picture."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from contourpy import LineType, contour_generator

from instrument.evaluation.chart import ChartData, colours_of, title_of
from instrument.evaluation.chart_figure import chart_figure
from instrument.files.atomic import write_text
from instrument.files.figures import ACCENT, INK, save_figure
from recon.arrays import Float64Array
from recon.evaluation.scored import is_known

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def chart_page(data: ChartData) -> str:
    """Return a page: points to hover over, families to switch off, axes to choose; the front by name.

    A click on a point or line picks its setting out, by name.
    """

    def known(axes: Iterable[Any]) -> list[dict[str, Any]]:
        return [asdict(axis) for axis in axes if any(is_known(p, axis.key) for p in data.points)]

    payload = json.dumps(
        {
            "points": [p.to_json() for p in data.points],
            "colours": colours_of(data),
            "costs": known(data.kind.costs),
            "scores": known(data.kind.scores),
            "groups": list(dict.fromkeys(p.group for p in data.points)),
        }
    ).replace("</", "<\\/")  # "</" inside a script would end it
    kind = "SIMULATED. " if data.about.get("simulated") else ""
    title = html.escape(f"{kind}{title_of(data)}")
    return _PAGE.replace("@TITLE@", title).replace("@DATA@", payload)


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>@TITLE@</title><style>
:root{color-scheme:light dark;--ink:#22303c;--ground:#fff;--line:#ddd}
@media(prefers-color-scheme:dark){:root{--ink:#dfe6ec;--ground:#14191e;--line:#36404a}}
body{font:14px system-ui,sans-serif;margin:1.5em;color:var(--ink);background:var(--ground)}
h1{font-size:1.2em}label{margin-right:1em;white-space:nowrap}
svg text{fill:var(--ink)}svg .grid{stroke:var(--line)}
#tip{position:absolute;background:var(--ground);border:1px solid #8496a5;padding:.4em .6em;
font-size:12px;white-space:pre;pointer-events:none;display:none}.front{stroke:var(--ink);stroke-width:1.5}
polyline{fill:none}.reach{stroke:transparent;stroke-width:11;cursor:pointer}circle{cursor:pointer}
</style></head><body><h1>@TITLE@</h1>
<p><span id="which">of: <select id="group"></select></span> x: <select id="x"></select>
y: <select id="y"></select> <span id="keys"></span></p>
<svg id="plot" width="900" height="520"></svg><div id="tip"></div>
<p>On the front (nothing is both cheaper and better):</p><ol id="named"></ol>
<script>
const data = @DATA@, plot = document.getElementById("plot"), tip = document.getElementById("tip");
const xs = document.getElementById("x"), ys = document.getElementById("y"), off = new Set();
let picked = null;
const group = document.getElementById("group"), named = document.getElementById("named");
for (const axis of data.costs) xs.add(new Option(axis.words, axis.key));
for (const axis of data.scores) ys.add(new Option(axis.words, axis.key));
for (const name of data.groups) group.add(new Option(name, name));
if (data.groups.length < 2) document.getElementById("which").hidden = true;
for (const [name, colour] of Object.entries(data.colours)) {
  const label = document.createElement("label"), box = document.createElement("input");
  box.type = "checkbox"; box.checked = true; label.style.color = colour;
  box.onchange = () => { box.checked ? off.delete(name) : off.add(name); draw(); };
  label.append(box, " " + name); document.getElementById("keys").append(label);
}
function node(kind, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [k, v] of Object.entries(attributes)) made.setAttribute(k, v);
  if (text !== undefined) made.textContent = text;
  plot.append(made); return made;
}
const short = v => String(Number(Number(v).toPrecision(3)));
function scale(values, logarithmic, from, to) {
  const f = v => logarithmic ? Math.log10(Math.max(v, 1e-4)) : v;
  const all = values.map(f); let low = Math.min(...all), high = Math.max(...all);
  const rim = (high - low || 1) * 0.05; low -= rim; high += rim;
  const place = v => from + (f(v) - low) / (high - low) * (to - from);
  let ticks = [];
  if (logarithmic) {
    const steps = high - low > 3 ? [1] : [1, 2, 5];
    for (let e = Math.floor(low); e <= high; e++) for (const s of steps) ticks.push(s * 10 ** e);
    ticks = ticks.filter(v => f(v) >= low && f(v) <= high);
  } else {
    const ten = 10 ** Math.floor(Math.log10((high - low) / 5)), least = (high - low) / 7;
    const step = ten * ([1, 2, 5].find(s => s * ten >= least) || 10);
    for (let i = Math.ceil(low / step); i * step <= high; i++) ticks.push(i * step);
  }
  return [place, ticks];
}
function draw() {
  plot.replaceChildren(); named.replaceChildren();
  const x = data.costs.find(a => a.key === xs.value), y = data.scores.find(a => a.key === ys.value);
  const left = 75, right = 880, top = 30, bottom = 470;
  const seen = data.points.filter(p => p.group === group.value && !off.has(p.family) &&
    p[x.key] !== null && p[y.key] !== null);
  if (!seen.length) { node("text", {x: left, y: 40}, "nothing to show"); return; }
  const [px, tx] = scale(seen.map(p => p[x.key]), x.logarithmic, left, right);
  const [py, ty] = scale(seen.map(p => p[y.key]), y.logarithmic, bottom, top);
  for (const v of tx) {
    node("line", {x1: px(v), x2: px(v), y1: top, y2: bottom, class: "grid"});
    node("text", {x: px(v), y: bottom + 18, "font-size": 12, "text-anchor": "middle"}, short(v));
  }
  for (const v of ty) {
    node("line", {x1: left, x2: right, y1: py(v), y2: py(v), class: "grid"});
    node("text", {x: left - 6, y: py(v) + 4, "font-size": 12, "text-anchor": "end"}, short(v));
  }
  node("text", {x: (left + right) / 2, y: bottom + 40, "font-size": 13, "text-anchor": "middle"}, x.words);
  node("text", {transform: `translate(16 ${(top + bottom) / 2}) rotate(-90)`, "font-size": 13,
    "text-anchor": "middle"}, y.words);
  const sign = y.more_is_better ? 1 : -1, front = [];
  for (const p of [...seen].sort((a, b) => a[x.key] - b[x.key] || sign * (b[y.key] - a[y.key])))
    if (!front.length || sign * p[y.key] > sign * front[front.length - 1][y.key]) front.push(p);
  const runs = new Map();
  for (const p of seen) runs.set(p.setting, [...(runs.get(p.setting) || []), p]);
  const line = (ps, attributes) => node("polyline", {...attributes,
    points: ps.map(p => px(p[x.key]) + "," + py(p[y.key])).join(" ")});
  if (!runs.has(picked)) picked = null;
  const opacity = (setting, usual) => !picked ? usual : setting === picked ? 1 : usual / 3;
  const pick = setting => event => {
    event.stopPropagation(); picked = picked === setting ? null : setting; draw();
  };
  for (const [setting, ps] of runs) line(ps, {stroke: data.colours[ps[0].family],
    "stroke-opacity": opacity(setting, 0.3), "stroke-width": setting === picked ? 3 : 1});
  node("polyline", {class: "front", points: front.map((p, i) => (i ? px(p[x.key]) + "," +
    py(front[i - 1][y.key]) + " " : "") + px(p[x.key]) + "," + py(p[y.key])).join(" ")});
  for (const [setting, ps] of runs) line(ps, {class: "reach"}).onclick = pick(setting);
  const times = n => n ? `, ${n} iteration${n > 1 ? "s" : ""}` : "";
  const words = p => p.setting + times(p.iterations);
  for (const p of front) {
    const item = document.createElement("li");
    item.textContent = words(p) + ": " + x.words + " " + short(p[x.key]) + ", " + y.words + " " +
      short(p[y.key]);
    named.append(item);
  }
  for (const p of seen) {
    const on = front.includes(p);
    const dot = node("circle", {cx: px(p[x.key]), cy: py(p[y.key]), r: on ? 6 : 4,
      fill: data.colours[p.family], "fill-opacity": opacity(p.setting, 0.7), class: on ? "front" : ""});
    dot.onclick = pick(p.setting);
    dot.onmousemove = event => {
      tip.style.display = "block";
      tip.style.left = event.pageX + 12 + "px"; tip.style.top = event.pageY + "px";
      tip.textContent = words(p) + (on ? "\\non the front" : "") + [...data.costs, ...data.scores]
        .filter(a => p[a.key] !== null)
        .map(a => "\\n" + a.words + ": " + Number(p[a.key]).toPrecision(4)).join("");
    };
    dot.onmouseleave = () => { tip.style.display = "none"; };
  }
  if (picked) node("text", {x: right, y: top - 12, "font-size": 14, "font-weight": "bold",
    "text-anchor": "end"}, picked);
}
plot.onclick = () => { picked = null; draw(); };
group.onchange = xs.onchange = ys.onchange = draw; draw();
</script></body></html>
"""


def write_charts(folder: Path, data: ChartData) -> tuple[Path, ...]:
    """Write chart.png, chart.html and chart.csv into a folder; return their paths."""
    picture, page, table = (folder / f"chart.{kind}" for kind in ("png", "html", "csv"))
    save_figure(chart_figure(data), picture)
    write_text(page, chart_page(data))
    write_text(table, data.to_csv())
    return picture, page, table


# Stability maps -------------------------------------------------------------------------------------
def map_figure(record: Mapping[str, Any]) -> Figure:
    """Draw a map as ``stability.json`` has it (one entry of ``maps``).

    Severity is shown from green (far from failing) over white (at the boundary) to brown (failed); each cell
    carries its error; the red line is the boundary, severity 1. Where a case of one's own was found to lie,
    ``case`` of a method, is a ring.
    """
    from matplotlib.figure import Figure

    methods = record["methods"]
    columns = min(len(methods), 3)
    rows = -(-len(methods) // columns)
    figure = Figure(figsize=(max(4.6 * columns + 0.9, 7.0), 3.5 * rows + 1.0), dpi=100, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(methods) :]:
        axis.set_axis_off()
    images = [
        _draw_map(axis, name, method, record)
        for axis, (name, method) in zip(axes, methods.items(), strict=False)
    ]
    bar = figure.colorbar(images[0], ax=list(axes), shrink=0.8, ticks=[-1, 0, 1])
    bar.ax.set_yticklabels(["10 times\nbelow", "boundary", "10 times\nabove"], fontsize=8)
    bar.set_label("severity", fontsize=9, color=INK)
    figure.suptitle(f"{record['title']} (SIMULATED)", fontsize=12, color=INK, wrap=True)
    return figure


def _draw_map(axes: Axes, name: str, method: Mapping[str, Any], record: Mapping[str, Any]) -> Any:
    severity = np.array([[np.nan if v is None else v for v in row] for row in method["severity"]], float)
    level = np.log10(np.maximum(severity, 1e-2))
    image = axes.imshow(level, origin="lower", aspect="auto", cmap="BrBG_r", vmin=-1, vmax=1)
    n_y, n_x = severity.shape
    for line in boundary_lines(severity):
        axes.plot(*line.T, color=ACCENT, lw=2.2)
    for iy, ix in np.ndindex(n_y, n_x):
        error = method["error"][iy][ix]
        if error is not None:
            colour = "white" if abs(level[iy, ix]) > 0.75 else INK
            axes.text(ix, iy, f"{error:.2g}", ha="center", va="center", fontsize=7, color=colour)
    if (case := method.get("case")) is not None:
        axes.plot(*case, "o", ms=26, mfc="none", mec=INK, mew=2.5)
        axes.annotate(
            "yours", case, (0, 17), textcoords="offset points", ha="center", fontsize=9, weight="bold"
        )
    for which, count in (("x", n_x), ("y", n_y)):
        about = record[which]
        getattr(axes, f"set_{which}ticks")(range(count))
        getattr(axes, f"set_{which}ticklabels")(ticks_of(about), fontsize=8)
        getattr(axes, f"set_{which}label")(label_of(about), fontsize=9, color=INK)
    axes.set_title(f"{name} (numbers: {record['error']})", fontsize=10, color=INK, loc="left")
    return image


def boundary_lines(severity: Float64Array) -> list[Float64Array]:
    """Return where a map (n_y, n_x) of severities crosses 1, as lines (points, 2) of x and y in cells.

    Interpolated on the logarithm of the severity; NaN: not known, no line goes there. A map of one row or
    column is one cell wide.
    """
    level = np.log10(np.maximum(severity, 1e-2))
    places = []
    for axis, n in enumerate(level.shape):
        places.append(np.arange(n) if n > 1 else np.array([-0.5, 0.5]))
        level = level if n > 1 else np.repeat(level, 2, axis)
    known = np.ma.masked_invalid(level)
    made = contour_generator(places[1], places[0], known, name="serial", line_type=LineType.Separate)
    return cast(list[Float64Array], made.lines(0.0))


def ticks_of(axis: Mapping[str, Any]) -> list[str]:
    """Return the names of an axis' ticks: their own where it has some, else the values."""
    own: list[str] = axis.get("ticks", [])
    return own or [_short(v) for v in axis["values"]]


def label_of(axis: Mapping[str, Any]) -> str:
    """Return an axis' label, with its unit where it has one."""
    return f"{axis['label']} ({axis['unit']})" if axis["unit"] else str(axis["label"])


def _short(value: float) -> str:
    return f"{value / 1000:g}k" if abs(value) >= 1000 else f"{value:g}"
