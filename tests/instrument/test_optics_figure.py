"""The page of a comparison of optics: what stands on it covers nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg

from instrument.evaluation.optics_figure import optics_figure
from recon.evaluation.optics_compared import DEPTHS_UM, OPTICS, Compared, Comparison


@pytest.mark.parametrize("falling", [False, True])
@pytest.mark.parametrize("n_lights", [1, 6])
def test_the_legend_stands_beside_the_curves(n_lights: int, falling: bool) -> None:
    photons = np.geomspace(1e3, 1e6, n_lights)
    image = np.zeros((80, 80), np.float32)
    planes = np.zeros((len(DEPTHS_UM), 80, 80), np.float32)
    found = {}
    for number, name in enumerate(OPTICS):
        values = np.linspace(10 + number, 25 + number, n_lights)[:: -1 if falling else 1]
        lights = dict(zip(photons.tolist(), values.tolist(), strict=True))
        found[name] = Compared(planes, image, image, dict.fromkeys(lights, image), lights, planes, 20.0, 0.5)
    figure = optics_figure(Comparison(found, image, planes))
    FigureCanvasAgg(figure).draw()
    axes = figure.axes[-1]
    assert isinstance(axes, Axes)
    legend = axes.get_legend()
    assert legend is not None
    place = legend.get_window_extent()
    assert axes.get_window_extent().padded(2).contains(place.x0, place.y0)
    assert axes.get_window_extent().padded(2).contains(place.x1, place.y1)
    for line in axes.get_lines():
        points = line.get_transform().transform(line.get_xydata())
        along = np.linspace(points[:-1], points[1:], 50).reshape(-1, 2) if n_lights > 1 else points
        assert not any(place.contains(*point) for point in along)
