"""Pictures of calibrations, drawn without a screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration_routines.angular_response import CUT_OFF, AngularResponse

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
    mark = " (SIMULATED)" if response.simulated else ""
    axes.set_title(f"Angular response of the sensor, {response.bench}{mark}", fontsize=10)
    return figure
