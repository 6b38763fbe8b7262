"""The one page of an analysis: what a paper's supplement would show of a camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from instrument.files.figures import ACCENT, INK, mark_simulated, style
from recon.analysis import Analysis
from recon.analysis.gram import ConditionCurve
from recon.analysis.points import PointTrial
from recon.analysis.stated_distance import InVolumes, Reached

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Panel = Callable[[Axes], None]

_QUIET = "#52667a"
_COLUMNS = 3
_WIDTH_IN, _HEAD_IN, _ROW_IN, _FOOT_IN, _NOTE_IN = 15.5, 1.35, 3.35, 0.3, 0.185
_GAP_IN, _FACT_IN, _LINE_IN = 0.09, 0.28, 0.2
"""In the column of figures: above a name, with the name, of a line."""
_BELOW_CHARACTERS, _BESIDE_CHARACTERS = 112, 98
"""Of a line of notes below the panels, and in two panels' room of the last row where that is free."""
_COLORS = ("#00798c", "#d1495b", "#edae49", "#30638e", "#6a4c93")


def draw_analysis(analysis: Analysis, title: str, subtitle: str = "", *, simulated: bool) -> Figure:
    """Draw the page: PSF, correlations, depth, field, condition numbers, point tests, grid, figures in words.

    Only panels that have something to show are there; the notes below say what the others lack.

    Parameters
    ----------
    title : str
        What was analysed, in a reader's words.
    subtitle : str
        Where it comes from.
    simulated : bool
        Whether the calibration came from the simulated bench, which the page then says.
    """
    from matplotlib.figure import Figure

    panels = _panels(analysis)
    rows = -(-len(panels) // _COLUMNS)
    lines = [line for block in _blocks(analysis.notes, _BESIDE_CHARACTERS) for line in block]
    beside = rows * _COLUMNS - len(panels) == 2 and len(lines) <= _ROW_IN * 0.8 / _NOTE_IN
    columns = ([], []) if beside else _note_columns(analysis.notes)
    note_rows = max(map(len, columns))
    notes_in = _NOTE_IN * note_rows + (0.35 if note_rows else 0.0)
    body_in = max(_ROW_IN * rows, _facts_in(analysis))  # neither panels nor words run into the notes
    height_in = _HEAD_IN + body_in + notes_in + _FOOT_IN
    figure = Figure(figsize=(_WIDTH_IN, height_in), dpi=110, facecolor="white")
    top, bottom = 1 - _HEAD_IN / height_in, (_FOOT_IN + notes_in + 0.35) / height_in
    sides: dict[str, Any] = {"left": 0.05, "right": 0.715, "top": top, "bottom": bottom}
    grid = figure.add_gridspec(rows, _COLUMNS, **sides, hspace=0.44, wspace=0.27)
    for number, draw in enumerate(panels):
        axes = figure.add_subplot(grid[divmod(number, _COLUMNS)])
        draw(axes)
        axes.set_title(
            f"({chr(97 + number)}) {axes.get_title(loc='left')}", fontsize=12, color=INK, loc="left", pad=6
        )
    _facts(figure, analysis, 0.745, top, height_in)
    place = grid[rows - 1, 1:].get_position(figure)
    below = [(x, (_FOOT_IN + notes_in - 0.15) / height_in) for x in (0.05, 0.53)]
    for (x, y), written in zip(
        [*below, (place.x0, place.y1)], [*columns, lines if beside else []], strict=True
    ):
        for row, line in enumerate(written):
            figure.text(x, y - row * _NOTE_IN / height_in, line, fontsize=9, color=INK, va="top")
    figure.text(0.05, 1 - 0.42 / height_in, title, fontsize=18, color=INK, weight="bold", va="center")
    figure.text(0.05, 1 - 0.78 / height_in, subtitle, fontsize=10.5, color=INK, va="center")
    if simulated:
        mark_simulated(figure, 1 - 0.45 / height_in)
    return figure


def _panels(analysis: Analysis) -> list[Panel]:
    """Return what draws each panel that has something to show, in the order of the page."""
    tests = analysis.points
    panels: list[Panel] = [lambda axes: _psf(axes, analysis), lambda axes: _autocorrelation(axes, analysis)]
    if 0 < analysis.axial.hyperfocal_um < np.inf:  # 0: no enlargement makes this PSF another
        panels.append(lambda axes: _depth_of_field(axes, analysis))
    if analysis.depth is not None:
        panels.append(lambda axes: _depth(axes, analysis))
    if len(analysis.field) > 1:
        panels.append(lambda axes: _field(axes, analysis))
    panels.append(lambda axes: _condition(axes, analysis.condition))
    if tests is not None:
        if (lateral := _shown(tests.lateral)) is not None:
            panels.append(lambda axes: _profile(axes, lateral, "Two points across", "pixels", 0))
        if (axial := _shown(tests.axial)) is not None:
            panels.append(lambda axes: _profile(axes, axial, "Two points along", "planes", 1))
        if (sixteen := _shown(tests.sixteen)) is not None:
            panels.append(lambda axes: _sixteen(axes, sixteen, analysis))
    if len(analysis.grid.z_um) > 1:
        panels.append(lambda axes: _voxels(axes, analysis))
    return panels


def _note_columns(notes: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the notes as the lines of two columns below the panels, whole notes in each."""
    blocks = _blocks(notes, _BELOW_CHARACTERS)
    left: list[str] = []
    right: list[str] = []
    half = sum(map(len, blocks)) / 2
    for block in blocks:
        (left if len(left) < half and not right else right).extend(block)
    return left, right


def _blocks(notes: Sequence[str], width: int) -> list[list[str]]:
    """Return each note's lines."""
    import textwrap

    wrapped = [textwrap.wrap(note, width) for note in notes]
    return [[f"•  {first}", *(f"    {line}" for line in others)] for first, *others in wrapped]


def facts(analysis: Analysis) -> list[tuple[str, str]]:
    """Return the figures in words, for the page and for the terminal."""
    a = analysis
    near, far = a.axial.depth_of_field_um(a.z_um)
    lines = [("depth analysed", f"{a.z_um / 1e3:.3g} mm")]
    if (reached := a.reached) is not None:
        lines += _reached(a, reached)
    if (volumes := a.in_volumes) is not None:
        lines += _in_volumes(a, volumes)
    lines += [
        (
            "optics: 70 % half width",
            f"{a.lateral.mean_px:.2f} px (x {a.lateral.half_width_px[1]:.2f}, "
            f"y {a.lateral.half_width_px[0]:.2f}), "
            f"{a.lateral.angle_deg(a.pitch_um, a.distance_um):.3f}°, "
            f"{a.lateral.object_um(a.pitch_um, a.distance_um, a.z_um):.3g} µm",
        ),
        (
            "optics: inner product 0.8",
            f"{a.lateral_inner.mean_px:.2f} px (x {a.lateral_inner.half_width_px[1]:.2f}, "
            f"y {a.lateral_inner.half_width_px[0]:.2f}), "
            f"{a.lateral_inner.object_um(a.pitch_um, a.distance_um, a.z_um):.3g} µm across; "
            f"{1e6 * a.axial_inner.step_per_um:.3g} /m along",
        ),
        ("optics: depth of field", f"-{_mm(near)}, +{_mm(far)}"),
        ("optics: hyperfocal distance", _mm(a.axial.hyperfocal_um)),
        (
            "usable field (half light)",
            f"±{a.half_light_deg[1]:.1f}° x ±{a.half_light_deg[0]:.1f}°",
        ),
        ("field of view (any light)", f"±{a.view_x.half_deg:.1f}° x ±{a.view_y.half_deg:.1f}°"),
        ("  limited by", a.view_x.limited_by),
    ]
    if (tests := a.points) is not None:
        if tests.lateral_px is not None:
            um = tests.lateral_px * a.pitch_um * a.z_um / a.distance_um
            lines.append(("optics: two points across", f"{tests.lateral_px:.2g} px, {um:.3g} µm"))
        if tests.axial_per_um is not None:
            apart = _mm(tests.axial_per_um * a.z_um**2)
            lines.append(("optics: two points along", f"{1e6 * tests.axial_per_um:.3g} /m, {apart}"))
        if tests.sixteen_factor is not None:
            lines.append(("optics: 16 points need", f"{tests.sixteen_factor:.2g} times these separations"))
    holds = "not known" if a.convolution_holds_deg is None else f"to {a.convolution_holds_deg:.3g}°"
    planes = f"{len(a.grid.z_um)} plane{'s' if len(a.grid.z_um) > 1 else ''} even in 1/z"
    lines += [
        ("convolution model holds", holds),
        ("model recommended", f"{a.model}"),
        ("", a.model_reason),
        (
            "voxels recommended",
            f"binning {a.grid.binning}, {planes}, "
            f"{a.grid.lateral_um[0]:.3g} to {a.grid.lateral_um[-1]:.3g} µm across",
        ),
    ]
    if a.lateral_spacing_um is not None:
        lines.append(("calibrate across every", _mm(a.lateral_spacing_um)))
    if a.axial_spacing_per_um is not None:
        lines.append(("calibrate along every", f"{1e6 * a.axial_spacing_per_um:.3g} /m"))
    return lines


def _reached(a: Analysis, reached: Reached) -> list[tuple[str, str]]:
    """Return what the default reconstruction reaches, in words."""
    y, x = reached.across_px
    known = [px for px in (x, y) if px is not None]
    if not known:
        return [("two points, picture", "told apart at no distance tried")]
    um = max(known) * a.pitch_um * a.z_um / a.distance_um
    each = ", ".join(
        f"{name} {px:.2f} px" if px is not None else f"{name} at no distance tried"
        for name, px in (("x", x), ("y", y))
    )
    lines = [("two points, picture", f"{each}, {um:.3g} µm ({reached.method})")]
    if reached.focus_um is not None:
        near, far = (_mm(v) for v in reached.focus_um)
        lines.append(("depth of field, picture", f"{near} to {far}, for pairs half as far again apart"))
    return lines


def _in_volumes(a: Analysis, found: InVolumes) -> list[tuple[str, str]]:
    """Return what default volumes reach, in words."""
    along = "told apart at no distance tried"
    if found.along_per_um is not None:
        along = f"{1e6 * found.along_per_um:.3g} /m, {_mm(found.along_per_um * a.z_um**2)}"
    sixteen = f"not told apart as far as {found.planes} planes go"
    if found.sixteen_factor is not None:
        sixteen = f"{found.sixteen_factor:.2g} times the optics' separations"
    return [("two points along, volume", along), ("16 points, volume", sixteen)]


def _mm(um: float) -> str:
    if not np.isfinite(um):
        return "infinity"
    if um < 1e3:
        return f"{um:.3g} µm"
    return f"{um / 1e3:.3g} mm" if um < 1e6 else f"{um / 1e6:.3g} m"


def _shown(trials: Sequence[PointTrial]) -> PointTrial | None:
    """Return the resolved trial nearest to the distance stated, which the last one has; else that one."""
    if not trials:
        return None
    stated = trials[-1]

    def off(trial: PointTrial) -> float:
        return abs(trial.separation_px - stated.separation_px) + abs(
            trial.separation_planes - stated.separation_planes
        )

    return min((trial for trial in trials if trial.resolved), key=off, default=stated)


def _note(
    axes: Axes, text: str, at: tuple[float, float], color: str, offset: tuple[float, float], **how: Any
) -> None:
    """Write beside a place, so many points off it."""
    axes.annotate(text, at, fontsize=9, color=color, xytext=offset, textcoords="offset points", **how)


def _psf(axes: Axes, a: Analysis) -> None:
    white = float(np.percentile(a.psf, 99.8)) or 1.0
    half_y, half_x = (n * a.pitch_um / 2e3 for n in a.psf.shape)
    axes.imshow(
        np.clip(a.psf / white, 0, 1) ** 0.7,
        cmap="gray",
        extent=(-half_x, half_x, half_y, -half_y),
        interpolation="antialiased",
    )
    style(axes, f"PSF at {a.z_um / 1e3:.3g} mm", "x on the sensor, mm", "y, mm")
    axes.grid(False)


def _autocorrelation(axes: Axes, a: Analysis) -> None:
    shown = min(len(a.autocorrelation), max(12, int(8 * a.lateral.mean_px)))
    axes.plot(np.arange(shown), a.autocorrelation[:shown], color=_COLORS[0], linewidth=1.8)
    for level, resolution, color in (
        (0.7, a.lateral.half_width_px[1], ACCENT),
        (0.8, a.lateral_inner.half_width_px[1], _COLORS[2]),
    ):
        axes.plot([0, resolution, resolution], [level, level, 0], color=color, linewidth=1, linestyle="--")
        _note(axes, f"{level:g} at {resolution:.2f} px", (resolution, level), color, (4, 2))
    axes.set_xlim(0, shown - 1)
    axes.set_ylim(0, 1.02)
    style(axes, "Autocorrelation", "shift, pixels (along x)", "inner product")


def _depth_of_field(axes: Axes, a: Analysis) -> None:
    hyperfocal = a.axial.hyperfocal_um
    z = np.geomspace(min(0.02 * hyperfocal, 0.5 * a.z_um), 0.97 * hyperfocal, 200)
    reach = [sum(a.axial.depth_of_field_um(float(v))) for v in z]
    axes.loglog(z / 1e3, np.array(reach) / 1e3, color=_COLORS[0], linewidth=1.8)
    axes.axvline(hyperfocal / 1e3, color=ACCENT, linestyle=":", linewidth=1.5)
    place = (hyperfocal / 1e3, reach[len(reach) // 2] / 1e3)
    aside: dict[str, Any] = {"rotation": 90, "ha": "right", "va": "center"}
    _note(axes, f"hyperfocal {_mm(hyperfocal)}", place, ACCENT, (-2, 0), **aside)
    style(axes, "Depth of field", "depth, mm", "depth of field, mm")


def _depth(axes: Axes, a: Analysis) -> None:
    assert a.depth is not None  # else there is no such panel
    axes.plot(a.depth.z_um / 1e3, a.depth.to_middle, "o-", color=_COLORS[0], markersize=3, linewidth=1.4)
    level = float(a.depth.cross_cut.max())
    axes.axhline(level, color=_COLORS[2], linewidth=1, linestyle="--")
    place = (float(a.depth.z_um[0]) / 1e3, level)
    _note(axes, "nearest with farthest, at any shift", place, _COLORS[2], (2, 3))
    axes.set_ylim(0, 1.03)
    style(axes, f"Similarity to the PSF at {a.depth.middle_um / 1e3:.3g} mm", "depth, mm", "inner product")


def _field(axes: Axes, a: Analysis) -> None:
    angles = [p.angle_deg for p in a.field]
    axes.plot(
        angles, [p.similarity for p in a.field], "o", color=_COLORS[0], markersize=4, label="inner product"
    )
    axes.plot(angles, [p.spot for p in a.field], "s", color=ACCENT, markersize=4, label="spot size / axis")
    axes.legend(fontsize=9, frameon=False)
    axes.set_ylim(0, 1.08 * max(1.0, *(p.similarity for p in a.field), *(p.spot for p in a.field)))
    style(axes, "Across the field, against the central PSF", "angle, degrees")


def _condition(axes: Axes, curves: Sequence[ConditionCurve]) -> None:
    from matplotlib.ticker import LogLocator

    styles = {"x": "-", "z": "--", "xz": ":"}
    counts = sorted({c.count for c in curves})
    for curve in curves:
        color = _COLORS[counts.index(curve.count) % len(_COLORS)]
        named: dict[str, Any] = {"label": f"{curve.count} in {curve.direction}", "color": color}
        line = f"o{styles[curve.direction]}"
        axes.semilogy(curve.separations, curve.values, line, markersize=3, linewidth=1.3, **named)
    axes.legend(fontsize=8.5, frameon=False, ncols=2)
    # Plain numbers: the range is often less than a decade, where powers of ten say little.
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0)))
    style(axes, "Local condition number", "separation, voxels", "condition number")
    axes.tick_params(which="minor", labelsize=9, colors=INK, length=2)


def _profile(axes: Axes, trial: PointTrial, title: str, unit: str, axis: int) -> None:
    profile = trial.map.sum(axis=axis)
    separation = trial.separation_planes if axis else trial.separation_px
    at = np.arange(len(profile)) - len(profile) // 2
    axes.plot(at, profile / profile.max(), drawstyle="steps-mid", color=_COLORS[0], linewidth=1.5)
    reach = 2.5 * separation + 2
    axes.set_xlim(-reach, reach)
    # Short enough for its panel: how deep the dip is can be seen.
    verdict = "" if trial.resolved else ", not resolved"
    style(axes, f"{title}: {separation:.3g} {unit}{verdict}", unit, "brightness found")


def _sixteen(axes: Axes, trial: PointTrial, a: Analysis) -> None:
    n_z, width = trial.map.shape
    axes.imshow(
        trial.map,
        cmap="magma",
        aspect="auto",
        interpolation="nearest",
        extent=(-width / 2, width / 2, n_z / 2, -n_z / 2),
    )
    reach = min(1.5 * trial.separation_px * 1.8 + 2, width / 2)
    axes.set_xlim(-reach, reach)
    factor = a.points.sixteen_factor if a.points is not None else None
    verdict = f"resolved at {factor:.2g} x" if factor is not None else "not always resolved"
    style(axes, f"16 points: {verdict}", "pixels", "planes")
    axes.grid(False)


def _voxels(axes: Axes, a: Analysis) -> None:
    """Recommended voxels in the x-z plane, to scale: every twentieth line across (Fig. 4.3d)."""
    z = np.array(a.grid.z_um) / 1e3
    tangent = np.tan(np.deg2rad(min(a.view_x.half_deg, 60.0)))
    step = max(1, len(z) // 12)
    for depth in z[::step]:
        axes.plot([-depth * tangent, depth * tangent], [depth, depth], color=_COLORS[0], linewidth=0.7)
    for share in np.linspace(-1, 1, 9):
        axes.plot(
            [share * tangent * z[0], share * tangent * z[-1]], [z[0], z[-1]], color=_COLORS[0], linewidth=0.5
        )
    style(axes, f"Voxel grid to scale: {len(z)} plane{'s' if len(z) > 1 else ''}", "x, mm", "z, mm")
    axes.grid(False)
    if len(z) > 1:
        axes.set_aspect("equal", adjustable="datalim")


def _facts_in(a: Analysis) -> float:
    """Return how high the column of figures is, inches."""
    lines = [_lines(value) for _, value in facts(a)]
    return sum(_FACT_IN * bool(name) for name, _ in facts(a)) + _LINE_IN * sum(map(len, lines))


def _lines(value: str) -> list[str]:
    import textwrap

    return textwrap.wrap(value, 46)


def _facts(figure: Figure, a: Analysis, x: float, top: float, height_in: float) -> None:
    """Write the figures in words down the right-hand column."""
    y = top
    for name, value in facts(a):
        if name:
            y -= _GAP_IN / height_in
            figure.text(x, y, name.strip(), fontsize=9.5, color=_QUIET, va="top")
            y -= (_FACT_IN - _GAP_IN) / height_in
        for line in _lines(value):
            figure.text(x, y, line, fontsize=10.5, color=INK, va="top")
            y -= _LINE_IN / height_in
