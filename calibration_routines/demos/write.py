"""The demo's files: raw frames, picture, volume, ground truth, chart, and one figure of everything."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from instrument.evaluation.chart import colours_of
from instrument.evaluation.chart_figure import draw_chart
from instrument.evaluation.figures import write_charts
from instrument.files.figures import (
    INK,
    Panel,
    draw_facts,
    draw_panel,
    mark_simulated,
    save_figure,
    style,
)
from instrument.files.images import write_image
from instrument.files.seen import as_seen, srgb
from instrument.reconstruction.result_figures import in_colour_of_depth
from recon.arrays import Float32Array, Float64Array
from recon.evaluation.scored import SECONDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from calibration_routines.demos.picture import Viewer
    from calibration_routines.demos.result import DemoResult

Float = Float32Array
_SCREEN_GAMMA = 1 / 2.2  # light to the levels of a screen
_MARGIN = 4  # dark pixels shown around the picture
_LIGHT_PX = 0.7  # a true light is drawn as a disc of this radius
_AROUND_PX = 16  # shown around the lights


def write_pictures(done: DemoResult, viewer: Viewer) -> dict[str, Path]:
    """Write the demo's pictures into its folder; returns what is where."""
    place, measured = done.folder, done.measured
    picture = done.comparison.scale * viewer.upright(viewer.picture(done.reconstruction.image), _MARGIN)
    truth = viewer.upright(viewer.truth, _MARGIN)
    files = {
        "summary figure": place / "summary.png",
        "picture": place / "picture.png",
        "picture, linear float32": place / "picture.tif",
        "ground truth, linear float32": place / "ground-truth.tif",
        "raw frame": place / "raw.tif",
        "lights, brightest over depth": place / "lights.png",
        "volume of the lights": place / "lights.tif",
        "calibration": measured.calibration.path,
    }
    write_image(files["raw frame"], measured.photos[1].raw)
    write_image(files["picture, linear float32"], picture.astype(np.float32))
    write_image(files["ground truth, linear float32"], truth.astype(np.float32))
    levels = 255 * np.clip(picture / viewer.truth.max(), 0, 1) ** _SCREEN_GAMMA
    write_image(files["picture"], np.round(levels).astype(np.uint8))
    write_image(files["volume of the lights"], done.volume.volume)
    write_image(
        files["lights, brightest over depth"], np.round(255 * _coloured(done.placed.seen)).astype(np.uint8)
    )
    files["chart of methods"] = write_charts(place, done.chart)[1]
    save_figure(_figure(done, viewer, picture, truth), files["summary figure"])
    return files


def _figure(done: DemoResult, viewer: Viewer, picture: Float, truth: Float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.0, 11.2), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    outer = figure.add_gridspec(
        3, 1, height_ratios=[2.75, 2.6, 3.2], hspace=0.26, left=0.048, right=0.985, top=0.925, bottom=0.055
    )
    pictures = outer[0].subgridspec(1, 4, wspace=0.06)
    for column, panel in enumerate(_pictures(done, viewer, picture, truth)):
        draw_panel(figure.add_subplot(pictures[0, column]), panel)
    depths = outer[1].subgridspec(1, 5, wspace=0.08, width_ratios=[0.92, 1.1, 1.1, 0.14, 0.96])
    for column, panel in enumerate(_lights(done)):
        draw_panel(figure.add_subplot(depths[0, column]), panel)
    _draw_from_above(figure.add_subplot(depths[0, 4]), done)
    bottom = outer[2].subgridspec(1, 3, width_ratios=[1.3, 0.72, 1.15])
    axes = figure.add_subplot(bottom[0, 0])
    draw_chart(axes, done.chart.points, SECONDS, done.chart.kind.scores[0], colours_of(done.chart))
    axes.set_title("Speed against accuracy (green, half the pixels)", fontsize=13, color=INK, loc="left")
    draw_facts(figure.add_subplot(bottom[0, 2]), _facts(done, truth))
    figure.text(0.048, 0.97, "Photographs without a lens", fontsize=17, color=INK, weight="bold", va="center")
    mark_simulated(figure, 0.97)
    return figure


def _pictures(done: DemoResult, viewer: Viewer, picture: Float, truth: Float) -> list[Panel]:
    settings, measured = done.settings, done.measured
    calibration = measured.calibration.calibration
    pitch_mm, z_mm = (calibration.geometry.pixel_pitch_um or 0.0) / 1e3, settings.scene_z_um / 1e3
    psf = calibration.psfs[settings.scene_plane, 0]
    raw, object_mm, white = measured.photos[1].raw, viewer.object_pitch_um / 1e3, float(truth.max())
    colour = f"PSNR {done.comparison.psnr_db:.1f} dB, SSIM {done.comparison.ssim:.2f}"
    return [
        Panel("Point spread function", as_seen(psf) / 255, f"source at {z_mm:.0f} mm", pitch_mm, 1.0, 1.0),
        Panel(
            "Photograph",
            as_seen(measured.colours) / 255,
            f"{raw.shape[1]} x {raw.shape[0]} pixels, {measured.photos[1].exposure_ms:.0f} ms",
            pitch_mm,
            1.0,
            1.0,
        ),
        Panel("Reconstruction", picture, colour, object_mm, _SCREEN_GAMMA, white),
        Panel("Ground truth", truth, f"a screen at {z_mm:.0f} mm", object_mm, _SCREEN_GAMMA, white),
    ]


def _lights(done: DemoResult) -> list[Panel]:
    placed, shape = done.placed, done.placed.seen.shape
    true = np.zeros(shape, np.float32)
    y, x = np.ogrid[: shape[1], : shape[2]]
    for (row, column), plane in zip(placed.pixels, placed.planes, strict=True):
        true[round(float(plane))][(y - row) ** 2 + (x - column) ** 2 <= _LIGHT_PX**2] = 1
    low, high = placed.pixels.min(axis=0) - _AROUND_PX, placed.pixels.max(axis=0) + _AROUND_PX
    rows, columns = (slice(max(0, int(a)), int(b)) for a, b in zip(low, high, strict=True))
    box = (slice(None), rows, columns)
    count = f"{placed.in_plane} of {len(placed.planes)} lights within half a plane"
    photo = done.measured.lights
    return [
        Panel(
            "Lights in a volume, as seen",
            as_seen(photo.measurement) / 255,
            f"{photo.exposure_ms:.0f} ms",
            None,
            1.0,
            1.0,
        ),
        Panel("Reconstruction: depth as colour", _coloured(placed.seen[box]), count, None, 1.0, 1.0),
        Panel("Ground truth", _coloured(true[box]), "blue: nearest plane, red: farthest", None, 1.0, 1.0),
    ]


def _coloured(seen: Float) -> Float64Array:
    """Return a volume's brightest light over depth in colours of its depth, upright, points made visible."""
    from scipy.ndimage import maximum_filter

    y, x = np.ogrid[-2:3, -2:3]
    wide = maximum_filter(seen, footprint=(y**2 + x**2 < 6)[None])[:, ::-1, ::-1]
    front = wide.max(axis=0)
    white = float(np.percentile(front, 99.7)) or 1.0
    return np.asarray(srgb(in_colour_of_depth(front, wide.argmax(axis=0), len(wide), white)))


def _draw_from_above(axes: Axes, done: DemoResult) -> None:
    """Draw depth against direction: where the lights were found, and where they are."""
    from matplotlib import colormaps

    placed, planes = done.placed, done.volume.grid.z_um
    last = len(planes) - 1
    across = done.placed.pixels[:, 1]
    colours = colormaps["turbo"](0.1 + 0.8 * placed.planes / max(last, 1))
    axes.scatter(
        -across, placed.planes, s=60, facecolors="none", edgecolors=INK, linewidths=0.8, label="true"
    )
    axes.scatter(-across, placed.found, s=22, c=colours, label="found")
    style(axes, "Seen from above", "direction", "", title_size=13)
    axes.set_xticks([])
    axes.set_yticks(range(last + 1), [f"{z / 1e3:.0f} mm" for z in planes])
    axes.legend(fontsize=9, frameon=False, loc="upper right")


def _facts(done: DemoResult, truth: Float) -> list[tuple[str, str]]:
    settings, result, volume = done.settings, done.reconstruction, done.volume
    height, width = result.image.shape[:2]
    size = f"{width} x {height}"
    return [
        ("bench", f"preset {settings.preset}, SIMULATED"),
        ("calibration", f"{settings.planes} planes, {settings.average} frames each"),
        ("photographs", f"red, green, blue; {settings.photograph_average} frames each"),
        ("on the screen", f"{truth.shape[1] - 2 * _MARGIN} x {truth.shape[0] - 2 * _MARGIN} pixels"),
        ("picture", f"{size} x 3, {result.solver} + {result.prior}: {len(result.history)} it."),
        (
            "volume",
            f"{size} x {len(volume.volume)}, {volume.solver} + {volume.prior}: {len(volume.history)} it.",
        ),
        ("compared", "in the screen, linear light, one factor"),
    ]
