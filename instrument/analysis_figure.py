"""The one page of an analysis: what a paper's supplement would show of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from recon.analysis import Analysis
from recon.analysis.condition import ConditionCurve
from recon.analysis.points import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INK = "#22303c"
_FAINT = "#8496a5"
_ACCENT = "#d1495b"
_COLORS = ("#00798c", "#d1495b", "#edae49", "#30638e", "#6a4c93")


def draw_analysis(analysis: Analysis, title: str, *, simulated: bool) -> Figure:
    """Draw the page: PSF, correlations, depth, field, condition numbers, point tests, grid, figures in words.

    Parameters
    ----------
    analysis : Analysis
    title : str
    simulated : bool
        Whether the calibration came from the simulated bench, which the page then says.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15.5, 11.0), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        3, 4, left=0.045, right=0.985, top=0.905, bottom=0.05, hspace=0.42, wspace=0.26
    )
    _psf(figure.add_subplot(grid[0, 0]), analysis)
    _autocorrelation(figure.add_subplot(grid[0, 1]), analysis)
    _depth_of_field(figure.add_subplot(grid[0, 2]), analysis)
    _facts(figure.add_subplot(grid[0:2, 3]), analysis)
    _depth(figure.add_subplot(grid[1, 0]), analysis)
    _field(figure.add_subplot(grid[1, 1]), analysis)
    _condition(figure.add_subplot(grid[1, 2]), analysis.condition)
    tests = analysis.points
    _profile(
        figure.add_subplot(grid[2, 0]),
        _shown(tests.lateral) if tests else None,
        "Two points across",
        "pixels",
        0,
    )
    _profile(
        figure.add_subplot(grid[2, 1]),
        _shown(tests.axial) if tests else None,
        "Two points along",
        "planes",
        1,
    )
    _sixteen(figure.add_subplot(grid[2, 2]), _shown(tests.sixteen) if tests else None, analysis)
    _voxels(figure.add_subplot(grid[2, 3]), analysis)
    figure.text(0.045, 0.965, title, fontsize=17, color=_INK, weight="bold", va="center")
    if simulated:
        figure.text(
            0.985,
            0.965,
            "SIMULATED",
            fontsize=14,
            weight="bold",
            color="white",
            ha="right",
            va="center",
            bbox={"boxstyle": "round,pad=0.35", "facecolor": _ACCENT, "edgecolor": "none"},
        )
    return figure


def facts(analysis: Analysis) -> list[tuple[str, str]]:
    """Return the figures in words, for the page and for the terminal."""
    a = analysis
    near, far = a.axial.depth_of_field_um(a.z_um)
    lines = [
        ("depth analysed", f"{a.z_um / 1e3:.4g} mm"),
        (
            "resolution, 70 % half width",
            f"{a.lateral.mean_px:.2f} px, {a.lateral.angle_deg(a.pitch_um, a.distance_um):.3f}°, "
            f"{a.lateral.object_um(a.pitch_um, a.distance_um, a.z_um):.3g} µm",
        ),
        (
            "inner product 0.8",
            f"{a.lateral_inner.mean_px:.2f} px, "
            f"{a.lateral_inner.object_um(a.pitch_um, a.distance_um, a.z_um):.3g} µm across; "
            f"{1e6 * a.axial_inner.step_per_um:.3g} /m along",
        ),
        ("depth of field", f"-{_mm(near)}, +{_mm(far)}"),
        ("hyperfocal distance", _mm(a.axial.hyperfocal_um)),
        ("field of view", f"±{a.view_x.half_deg:.1f}° x ±{a.view_y.half_deg:.1f}°"),
        ("  limited by", a.view_x.limited_by),
    ]
    if (tests := a.points) is not None:
        if tests.lateral_px is not None:
            um = tests.lateral_px * a.pitch_um * a.z_um / a.distance_um
            lines.append(("two points across", f"{tests.lateral_px:.2g} px, {um:.3g} µm"))
        if tests.axial_per_um is not None:
            lines.append(
                (
                    "two points along",
                    f"{1e6 * tests.axial_per_um:.3g} /m, {_mm(tests.axial_per_um * a.z_um**2)}",
                )
            )
        if tests.sixteen_factor is not None:
            lines.append(("16 points need", f"{tests.sixteen_factor:.2g} times these separations"))
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


def _mm(um: float) -> str:
    if not np.isfinite(um):
        return "infinity"
    if um < 1e3:
        return f"{um:.3g} µm"
    return f"{um / 1e3:.3g} mm" if um < 1e6 else f"{um / 1e6:.3g} m"


def _shown(trials: Sequence[Trial]) -> Trial | None:
    """Return the smallest resolved trial, or the last."""
    return next((t for t in trials if t.resolved), trials[-1] if trials else None)


def _style(axes: Axes, title: str, x: str = "", y: str = "") -> None:
    axes.set_title(title, fontsize=11.5, color=_INK, loc="left", pad=5)
    axes.set_xlabel(x, fontsize=9, color=_INK)
    axes.set_ylabel(y, fontsize=9, color=_INK)
    axes.tick_params(labelsize=8, colors=_INK, length=2)
    axes.grid(True, color="#e3e8ec", linewidth=0.7)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_edgecolor(_FAINT)


def _missing(axes: Axes, title: str, why: str) -> None:
    _style(axes, title)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)
    axes.text(0.5, 0.5, why, ha="center", va="center", fontsize=9, color=_FAINT, transform=axes.transAxes)


def _psf(axes: Axes, a: Analysis) -> None:
    white = float(np.percentile(a.psf, 99.8)) or 1.0
    half_y, half_x = (n * a.pitch_um / 2e3 for n in a.psf.shape)
    axes.imshow(
        np.clip(a.psf / white, 0, 1) ** 0.7,
        cmap="gray",
        extent=(-half_x, half_x, half_y, -half_y),
        interpolation="antialiased",
    )
    _style(axes, f"PSF at {a.z_um / 1e3:.4g} mm", "mm on the sensor")
    axes.grid(False)


def _autocorrelation(axes: Axes, a: Analysis) -> None:
    shown = min(len(a.autocorrelation), max(12, int(8 * a.lateral.mean_px)))
    axes.plot(np.arange(shown), a.autocorrelation[:shown], color=_COLORS[0], linewidth=1.8)
    for level, resolution, color in (
        (0.7, a.lateral.half_width_px[1], _ACCENT),
        (0.8, a.lateral_inner.half_width_px[1], _COLORS[2]),
    ):
        axes.plot([0, resolution, resolution], [level, level, 0], color=color, linewidth=1, linestyle="--")
        axes.annotate(
            f"{resolution:.2f} px",
            (resolution, level),
            fontsize=8,
            color=color,
            xytext=(4, 2),
            textcoords="offset points",
        )
    axes.set_xlim(0, shown - 1)
    axes.set_ylim(0, 1.02)
    _style(axes, "Autocorrelation", "shift, pixels (along x)", "inner product")


def _depth_of_field(axes: Axes, a: Analysis) -> None:
    hyperfocal = a.axial.hyperfocal_um
    if not np.isfinite(hyperfocal):
        _missing(axes, "Depth of field", "the pattern does not change along the axis")
        return
    z = np.geomspace(min(0.02 * hyperfocal, 0.5 * a.z_um), 0.97 * hyperfocal, 200)
    reach = [sum(a.axial.depth_of_field_um(float(v))) for v in z]
    axes.loglog(z / 1e3, np.array(reach) / 1e3, color=_COLORS[0], linewidth=1.8)
    axes.axvline(hyperfocal / 1e3, color=_ACCENT, linestyle=":", linewidth=1.5)
    axes.annotate(
        f"hyperfocal {_mm(hyperfocal)}",
        (hyperfocal / 1e3, reach[len(reach) // 2] / 1e3),
        fontsize=8,
        color=_ACCENT,
        rotation=90,
        ha="right",
        va="center",
        xytext=(-2, 0),
        textcoords="offset points",
    )
    _style(axes, "Depth of field", "depth, mm", "mm")


def _depth(axes: Axes, a: Analysis) -> None:
    if a.depth is None:
        _missing(axes, "Similarity along depth", "one depth was calibrated")
        return
    axes.plot(a.depth.z_um / 1e3, a.depth.to_middle, "o-", color=_COLORS[0], markersize=3, linewidth=1.4)
    axes.axhline(float(a.depth.cross_cut.max()), color=_COLORS[2], linewidth=1, linestyle="--")
    axes.annotate(
        "nearest with farthest, at any shift",
        (a.depth.z_um[0] / 1e3, a.depth.cross_cut.max()),
        fontsize=7.5,
        color=_COLORS[2],
        xytext=(2, 3),
        textcoords="offset points",
    )
    axes.set_ylim(0, 1.03)
    _style(axes, f"Similarity to the PSF at {a.depth.middle_um / 1e3:.4g} mm", "depth, mm", "inner product")


def _field(axes: Axes, a: Analysis) -> None:
    if len(a.field) < 2:
        _missing(axes, "Similarity across the field", "one place of the field was calibrated")
        return
    angles = [p.angle_deg for p in a.field]
    axes.plot(
        angles, [p.similarity for p in a.field], "o", color=_COLORS[0], markersize=4, label="inner product"
    )
    axes.plot(angles, [p.spot for p in a.field], "s", color=_ACCENT, markersize=4, label="spot size / axis")
    axes.legend(fontsize=8, frameon=False)
    axes.set_ylim(bottom=0)
    _style(axes, "Across the field, against the central PSF", "angle, degrees")


def _condition(axes: Axes, curves: Sequence[ConditionCurve]) -> None:
    styles = {"x": "-", "z": "--", "xz": ":"}
    counts = sorted({c.count for c in curves})
    for curve in curves:
        color = _COLORS[counts.index(curve.count) % len(_COLORS)]
        axes.semilogy(
            curve.separations,
            curve.values,
            styles[curve.direction],
            color=color,
            marker="o",
            markersize=3,
            linewidth=1.3,
            label=f"{curve.count} in {curve.direction}",
        )
    axes.legend(fontsize=7, frameon=False, ncols=2)
    _style(axes, "Local condition number", "separation, voxels")


def _profile(axes: Axes, trial: Trial | None, title: str, unit: str, axis: int) -> None:
    if trial is None:
        _missing(axes, title, "not tested")
        return
    profile = trial.map.sum(axis=axis)
    separation = trial.separation_planes if axis else trial.separation_px
    at = np.arange(len(profile)) - len(profile) // 2
    axes.plot(at, profile / profile.max(), drawstyle="steps-mid", color=_COLORS[0], linewidth=1.5)
    reach = 2.5 * separation + 2
    axes.set_xlim(-reach, reach)
    verdict = f"dip {trial.dip:.0%}" if trial.resolved else "not resolved"
    _style(axes, f"{title}, {separation:.3g} {unit}: {verdict}", unit)


def _sixteen(axes: Axes, trial: Trial | None, a: Analysis) -> None:
    if trial is None:
        _missing(axes, "16 points", "not tested")
        return
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
    verdict = f"resolved at {factor:.2g} x" if factor is not None else "not resolved"
    _style(axes, f"16 points in x and z: {verdict}", "pixels", "planes")
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
    _style(axes, f"Voxel grid to scale: {len(z)} plane{'s' if len(z) > 1 else ''}", "x, mm", "z, mm")
    axes.grid(False)
    if len(z) > 1:
        axes.set_aspect("equal", adjustable="datalim")


def _facts(axes: Axes, a: Analysis) -> None:
    """Write the figures and notes down the column, spaced so that all of them fit."""
    import textwrap

    axes.set_axis_off()
    rows: list[tuple[str, float, float, str]] = []  # text, indent, size, colour
    for name, value in facts(a):
        if name:
            rows.append((name, 0.0, 8.5, _FAINT))
        rows += [(line, 0.02, 9.5, _INK) for line in textwrap.wrap(value, 46)]
    for note in a.notes:
        rows += [(line, 0.0, 7.0, _FAINT) for line in textwrap.wrap(note, 62)]
    step = min(1.0 / sum(size for *_, size, _ in rows), 0.0045)
    y = 1.03
    for text, indent, size, color in rows:
        axes.text(indent, y, text, transform=axes.transAxes, fontsize=size, color=color, va="top")
        y -= 1.04 * size * step
