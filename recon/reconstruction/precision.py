"""In which precision to compute: float32, unless the stability map says otherwise."""

from __future__ import annotations

import numpy as np

from recon.reconstruction.choice import Decision, Option
from recon.reconstruction.overrides import Overrides
from recon.verdict.cases import shipped_maps
from recon.verdict.map import PRECISION

METHOD = "admm tv"
"""Of the map; it is ADMM that reconstructs what is chosen here. The map is of pictures; those of volumes are
ADMM as well, with sums as long for each of their planes."""
DOUBLE_COST = 2.0
"""Time of float64 relative to float32: transforms move twice the bytes."""


def drift(iterations: int, pixels: int) -> float:
    """Return how far float32 is expected to differ from float64, relative to the solution.

    From the shipped map over iterations and size of the picture, by powers of both that its points give;
    never falling with either beyond what was measured.
    """
    found = shipped_maps()["precision"]
    x, y = (np.asarray(found[axis]["values"], float) for axis in ("x", "y"))
    error = np.asarray(found["methods"][METHOD]["error"], float)
    rows, columns = np.meshgrid(np.log(y / y.mean()), np.log(x / x.mean()), indexing="ij")
    table = np.stack([np.ones(error.size), rows.ravel(), columns.ravel()], axis=1)
    _, by_size, by_count = np.linalg.lstsq(table, np.log(np.maximum(error, 1e-12)).ravel(), rcond=None)[0]
    grown = max(by_size, 0.0) * np.log(max(pixels / y.max(), 1.0)) + max(by_count, 0.0) * np.log(
        max(iterations / x.max(), 1.0)
    )
    return float(error.max() * np.exp(grown))


def precision_of(overrides: Overrides, iterations: int, pixels: int) -> Decision:
    """Decide in which precision to compute.

    Parameters
    ----------
    overrides : Overrides
    iterations, pixels : int
        How many are usual, and the longest side.
    """
    expected = drift(iterations, pixels)
    asked = overrides.precision is not None
    why = (
        f"by the stability map float32 differs from float64 by at most {expected:.0e} of the picture after "
        f"{iterations} iterations on {pixels} pixels ({PRECISION:.0%} is a failure)"
    )
    loss = 0.0 - 10 * float(np.log10(1 + expected**2))
    numbers = {"expected_difference": expected}
    value = overrides.precision or ("float64" if expected > PRECISION else "float32")
    if value == "float64":
        down = Option("float32", 1 / DOUBLE_COST, loss)
        return Decision("precision", value, why, 0.0, None, down, asked, numbers)
    up = Option("float64", DOUBLE_COST, abs(loss))
    return Decision("precision", value, why, loss, up, None, asked, numbers)
