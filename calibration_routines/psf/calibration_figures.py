"""Pictures of calibrations, drawn without a screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration_routines.optics.angular_response import CUT_OFF, AngularResponse
from calibration_routines.optics.dpc import DiffuserSurface

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = ("#00798c", "#d1495b")


def response_figure(response: AngularResponse) -> Figure:
    """Draw the response along x and y with the cut-off angles."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, curve, colour in zip("xy", (response.along_x, response.along_y), _COLOURS, strict=True):
        cut_off = curve.cut_off_deg
        label = f"along {name}" + ("" if cut_off is None else f": {CUT_OFF:.0%} at {cut_off:.1f} degrees")
        axes.plot(curve.angles_deg, curve.response, ".-", color=colour, label=label)
        for side, sign in zip(curve.cut_offs_deg(), (-1, 1), strict=True):
            if side is not None:
                axes.plot([sign * side], [CUT_OFF], "o", mfc="none", color=colour)
    axes.axhline(CUT_OFF, color="#8496a5", lw=0.8)
    axes.set(xlabel="angle of incidence, degrees", ylabel="response relative to the axis", ylim=(0, None))
    axes.set_xlim(*(1.05 * np.array([-1, 1]) * max(map(abs, response.along_x.angles_deg))))
    axes.legend(frameon=False)
    axes.set_title(f"Angular response of the sensor, {response.bench}", fontsize=10)
    return figure


def surface_figure(surface: DiffuserSurface) -> Figure:
    """Draw a diffuser's height, a cut, and histograms of slope and deflection (Kuo 2020, Fig. A.1)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.2, 1), height_ratios=(1.6, 1))
    height, width = (n * surface.pitch_um for n in surface.height_um.shape)
    axes = figure.add_subplot(grid[0, 0])
    shown = axes.imshow(surface.height_um, extent=(0, width, height, 0), cmap="viridis")
    axes.axhline(height / 2, color="white", ls="--", lw=0.8)
    axes.set(xlabel="x in the sample, µm", ylabel="y, µm", title="Height above the best plane")
    figure.colorbar(shown, ax=axes, label="height, µm")
    axes = figure.add_subplot(grid[1, 0])
    row = surface.height_um[surface.height_um.shape[0] // 2]
    axes.plot((np.arange(len(row)) + 0.5) * surface.pitch_um, row, color=_COLOURS[0])
    axes.set(xlabel="x in the sample, µm", ylabel="height, µm", title="Along the dashed line")
    figures = surface.figures
    for place, values, colour, title in (
        (
            grid[0, 1],
            surface.slope_deg,
            _COLOURS[0],
            f"Slope: mean {figures['slope_mean_deg']:.2f}°",
        ),
        (
            grid[1, 1],
            surface.deflection_deg,
            _COLOURS[1],
            f"Deflection: half width {figures['deflection_hwhm_deg']:.2f}°, largest "
            f"{figures['deflection_largest_deg']:.2f}°",
        ),
    ):
        axes = figure.add_subplot(place)
        axes.hist(values.ravel(), bins=80, color=colour, density=True)
        axes.set(xlabel=f"{title.split(':')[0].lower()}, degrees", ylabel="density, 1/degree", title=title)
    figure.suptitle(f"Diffuser by differential phase contrast, {surface.bench}", fontsize=10)
    return figure
