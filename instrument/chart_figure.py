"""A chart of speed against accuracy as a picture, and as a page to look into."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import TYPE_CHECKING

from instrument.atomic import whole_file, write_text
from instrument.chart_job import ChartData
from instrument.figures import save_figure
from recon.chart import Point

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#00798c", "#d1495b", "#edae49", "#66a182", "#2e4057", "#8d96a3", "#9b5de5", "#f15bb5")


def write_charts(folder: Path, data: ChartData) -> tuple[Path, ...]:
    """Write chart.png, chart.html and chart.csv into a folder; return their paths."""
    picture, page, table = (folder / f"chart.{kind}" for kind in ("png", "html", "csv"))
    with whole_file(picture) as temporary:
        save_figure(chart_figure(data), temporary)
    write_text(page, chart_page(data))
    write_text(table, data.to_csv())
    return picture, page, table


def _families(data: ChartData) -> dict[str, str]:
    """Give every method and model a colour."""
    names = sorted({_family(p) for p in data.points})
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def _family(point: Point) -> str:
    return " ".join(point.setting.split()[:2])


def _value(point: Point, *, truth: bool) -> float:
    return point.psnr_db if truth else point.held_out


def _label(*, truth: bool) -> str:
    return "PSNR (dB)" if truth else "error on held-out pixels (noise = 1)"


def chart_figure(data: ChartData) -> Figure:
    """Draw time and memory against the error; the Pareto front as a line with names."""
    from matplotlib.figure import Figure

    truth = data.has_truth
    colours = _families(data)
    figure = Figure(figsize=(11, 5.2))
    by_time, by_memory = figure.subplots(1, 2, sharey=True, width_ratios=(1.7, 1))
    for name, colour in colours.items():
        own = [
            p for p in data.points if _family(p) == name and _value(p, truth=truth) == _value(p, truth=truth)
        ]
        y = [_value(p, truth=truth) for p in own]
        by_time.plot([max(p.seconds, 1e-4) for p in own], y, "o", ms=3, color=colour, alpha=0.6, label=name)
        by_memory.plot([max(p.peak_mib, 0.1) for p in own], y, "o", ms=3, color=colour, alpha=0.6)
    front = data.front()
    by_time.plot(
        [max(p.seconds, 1e-4) for p in front],
        [_value(p, truth=truth) for p in front],
        "k-",
        lw=1,
        label="Pareto front",
    )
    best_of = {p.setting: p for p in front}  # each setting's best point on the front
    lines = []
    for number, p in enumerate(sorted(best_of.values(), key=lambda p: p.seconds), start=1):
        place = (max(p.seconds, 1e-4), _value(p, truth=truth))
        by_time.annotate(str(number), place, fontsize=7, xytext=(-3, 5), textcoords="offset points")
        lines.append(f"{number}  {p.setting}, {p.iterations or 1} it.")
    by_time.text(
        0.99, 0.02, "\n".join(lines), fontsize=6, ha="right", va="bottom", transform=by_time.transAxes
    )
    by_time.set(xscale="log", xlabel="time of the solver (s)", ylabel=_label(truth=truth))
    if any(p.peak_mib == p.peak_mib for p in data.points):
        by_memory.set_xscale("log")
    by_memory.set(xlabel="memory beyond the input's, at the peak (MiB)")
    if not truth:
        by_time.set_yscale("log")
    by_time.legend(fontsize=7, loc="upper left")
    kind = "SIMULATED " if data.about.get("simulated") else ""
    figure.suptitle(f"{kind}speed against accuracy: {_title(data)}", fontsize=10)
    figure.tight_layout()
    return figure


def _title(data: ChartData) -> str:
    about = data.about
    pixels = " x ".join(str(n) for n in about.get("pixels", ()))
    what = about.get("scene") or (about.get("inputs") or {}).get("image", {}).get("path", "photograph")
    return f"{Path(str(what)).name}, {pixels} pixels"


def chart_page(data: ChartData) -> str:
    """Return a page without any other file: points to hover over, methods to switch off, axes to choose."""
    truth = data.has_truth
    front = {(p.setting, p.iterations) for p in data.front()}
    points = [
        {**p.to_json(), "family": _family(p), "front": (p.setting, p.iterations) in front}
        for p in data.points
    ]
    measures = [["psnr_db", "PSNR (dB)"], ["ssim", "SSIM"], ["nrmse", "NRMSE"]] if truth else []
    measures += [["held_out", _label(truth=False)], ["residual", "residual (noise = 1)"]]
    # "</" inside a script would end it.
    payload = json.dumps({"points": points, "colours": _families(data), "measures": measures}).replace(
        "</", "<\\/"
    )
    title = html.escape(f"Speed against accuracy: {_title(data)}")
    return _PAGE.replace("@TITLE@", title).replace("@DATA@", payload)


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>@TITLE@</title><style>
body{font:14px system-ui,sans-serif;margin:1.5em;color:#22303c}h1{font-size:1.2em}
label{margin-right:1em}#tip{position:absolute;background:#fff;border:1px solid #8496a5;padding:.4em .6em;
font-size:12px;white-space:pre;pointer-events:none;display:none}.front{stroke:#000;stroke-width:1.5}
</style></head><body><h1>@TITLE@</h1>
<p>x: <select id="x"><option value="seconds">time of the solver (s)</option>
<option value="peak_mib">memory at the peak (MiB)</option></select>
y: <select id="y"></select> <span id="keys"></span></p>
<svg id="plot" width="900" height="520"></svg><div id="tip"></div>
<script>
const data = @DATA@, plot = document.getElementById("plot"), tip = document.getElementById("tip");
const xs = document.getElementById("x"), ys = document.getElementById("y"), off = new Set();
for (const [name, label] of data.measures) ys.add(new Option(label, name));
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
function draw() {
  plot.replaceChildren();
  const x = xs.value, y = ys.value, left = 60, right = 880, top = 15, bottom = 480;
  const seen = data.points.filter(p => !off.has(p.family) && p[x] !== null && p[y] !== null);
  if (!seen.length) { node("text", {x: left, y: 40}, "nothing to show"); return; }
  const log = v => Math.log10(Math.max(v, 1e-4));
  const fx = seen.map(p => log(p[x])), fy = seen.map(p => p[y]);
  const low = Math.floor(Math.min(...fx)), high = Math.max(Math.ceil(Math.max(...fx)), low + 1);
  let bot = Math.min(...fy), up = Math.max(...fy); const rim = (up - bot || 1) * 0.05; bot -= rim; up += rim;
  const px = v => left + (v - low) / (high - low) * (right - left);
  const py = v => bottom - (v - bot) / (up - bot) * (bottom - top);
  for (let e = low; e <= high; e++) {
    node("line", {x1: px(e), x2: px(e), y1: top, y2: bottom, stroke: "#ddd"});
    node("text", {x: px(e) - 12, y: bottom + 18, "font-size": 12}, Math.pow(10, e).toPrecision(1));
  }
  for (let i = 0; i <= 5; i++) {
    const v = bot + (up - bot) * i / 5;
    node("line", {x1: left, x2: right, y1: py(v), y2: py(v), stroke: "#ddd"});
    node("text", {x: 5, y: py(v) + 4, "font-size": 12}, v.toPrecision(3));
  }
  for (const p of seen) {
    const dot = node("circle", {cx: px(log(p[x])), cy: py(p[y]), r: p.front ? 6 : 4,
      fill: data.colours[p.family], "fill-opacity": 0.7, class: p.front ? "front" : ""});
    dot.onmousemove = event => {
      tip.style.display = "block";
      tip.style.left = event.pageX + 12 + "px"; tip.style.top = event.pageY + "px";
      const show = (k, unit) => p[k] === null ? "" : "\\n" + k + " " + Number(p[k]).toPrecision(4) + unit;
      tip.textContent = p.setting + (p.iterations ? ", " + p.iterations + " iterations" : "") +
        (p.front ? "\\non the Pareto front" : "") + show("seconds", " s") + show("peak_mib", " MiB") +
        show("psnr_db", " dB") + show("ssim", "") + show("nrmse", "") + show("held_out", "") +
        show("residual", "");
    };
    dot.onmouseleave = () => { tip.style.display = "none"; };
  }
}
xs.onchange = ys.onchange = draw; draw();
</script></body></html>
"""
