"""Where a reconstruction of one's own lies on a stability map: at the cell that is most like it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.verdict.cases import group_of
from recon.verdict.chance import DERIVED, place_of, shipped_chances


@dataclass(frozen=True, slots=True)
class Likeness:
    """A map's cell that a reconstruction is like.

    Attributes
    ----------
    method : str
        The map's, of those that fail alike.
    ix, iy : int
    severity : float
        Of the cell's scene that is most like it; from 1 on it failed.
    distance : float
        Between the two, in the scatter of all cases.
    """

    method: str
    ix: int
    iy: int
    severity: float
    distance: float


def most_like(evidence: Mapping[str, float], method: str, record: Mapping[str, Any]) -> Likeness | None:
    """Return the cell of a map (an entry of ``maps`` in ``stability.json``) that evidence is most like.

    ``evidence`` and ``method`` are those of a verdict. None where the map has no method that fails alike, or
    its cells tell too little.
    """
    group = group_of(method)
    chances = None if group is None else shipped_chances().get(group)
    if chances is None or not {"signal", "unexplained", "edges", "lit"} <= {*evidence}:
        return None
    found = []
    methods = {
        name: r.get("evidence", ()) for name, r in record["methods"].items() if group_of(name) == group
    }
    for name, told in {method: methods[method]}.items() if methods.get(method) else methods.items():
        # Older cells were asked for less: the scatter of what both tell.
        known = [f in DERIVED or all(f in one for one in (evidence, *told)) for f in chances.features]
        if not told or not any(known):
            continue
        features = [feature for feature, both in zip(chances.features, known, strict=True) if both]
        precision = np.linalg.inv(np.linalg.inv(chances.precision)[np.ix_(known, known)])
        mine, spread = place_of(evidence, features), chances.spread[known]
        for cell in told:
            step = (place_of(cell, features) - mine) / spread
            distance = float(np.sqrt(step @ precision @ step))
            found.append(Likeness(name, cell["ix"], cell["iy"], cell["severity"], distance))
    return min(found, key=lambda like: like.distance, default=None)
