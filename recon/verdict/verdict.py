"""The verdict on a reconstruction: how it lies to the boundaries of the shipped stability maps."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


class Region(enum.StrEnum):
    """Where a reconstruction lies."""

    INSIDE = "inside"
    NEAR = "near"
    OUTSIDE = "outside"
    UNKNOWN = "unknown"


WORDS: Mapping[Region, str] = {
    Region.INSIDE: "reliable: inside the region where {method} works",
    Region.NEAR: "doubtful: near the boundary where {method} fails",
    Region.OUTSIDE: "not reliable: outside the region where {method} works",
    Region.UNKNOWN: "not judged: the stability maps hold no case of {method} that is much like this one",
}

UNFINISHED = 10.0
"""``unsettled`` from which no similar case is asked any more: the picture had hardly begun to settle."""
FIRST_ITERATIONS = "not reliable: the iterations were ended when the picture had hardly begun to settle"
STILL_CHANGING = "doubtful: the iterations were ended while the picture still changed; similar ones are good"
NOISELESS = 1e3
"""``signal`` from which the data are no photograph's: a full well of 100,000 electrons gives some 300."""
COMPUTED = (
    "not judged: the measurement has next to no noise, as computed images have, and verdicts are made from "
    "photographs"
)
LOST = 0.5
"""Share of failures among similar cases from which a reconstruction is outside."""


def reliable_share(method: str) -> float:
    """Return the share of failures among similar cases up to which a reconstruction is inside.

    Failures of volumes lie among the good ones, most of them little worse than trivial: with 5 % few volumes
    would ever be inside, and with total variation no more of those that 10 % lets in fail. With l1 they do.
    """
    return 0.1 if method == "volume tv" else 0.05


@dataclass(frozen=True, slots=True)
class Finding:
    """One stress that makes a reconstruction less reliable.

    Attributes
    ----------
    stress : str
        Name of the evidence, see :class:`~recon.verdict.evidence.Evidence`.
    value : float
        What was measured.
    gain : float
        By how much the share of failing cases would fall, were this one as in a good case; where no case is
        much like it, by how much nearer the nearest would be.
    words, help : str
        What it is, and what would help.
    """

    stress: str
    value: float
    gain: float
    words: str
    help: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether to trust a reconstruction.

    Attributes
    ----------
    region : Region
    method : str
        The maps' name of the method.
    failing : float or None
        Share of the most similar cases of the maps that failed; None where there are none.
    findings : tuple of Finding
        What limits, the most limiting first.
    evidence : mapping
        What was measured, see :class:`~recon.verdict.evidence.Evidence`.
    basis : str
        By which cases it was judged.
    """

    region: Region
    method: str
    failing: float | None
    findings: tuple[Finding, ...]
    evidence: Mapping[str, float] = field(default_factory=dict)
    basis: str = ""

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in plain words: what, which stress limits it, what would help."""
        said = [WORDS[self.region].format(method=self.method)]
        unfinished = self.evidence.get("unsettled", 0.0) >= UNFINISHED
        if unfinished and self.failing is not None and self.failing < LOST:
            said = [FIRST_ITERATIONS]  # that is why; the share of similar cases would contradict it
        elif self._still_changing:
            said = [STILL_CHANGING]
        elif self.region is Region.UNKNOWN and self.evidence.get("signal", 0.0) >= NOISELESS:
            said = [COMPUTED]
        elif self.failing is not None and self.region is not Region.UNKNOWN:
            said[0] += f" (of the most similar simulated cases {self.failing:.0%} failed)"
        if self.region in (Region.NEAR, Region.OUTSIDE):
            said += [f"{f.words}. {f.help}" for f in self.findings[:MOST]]
        elif self.region is Region.UNKNOWN and said[0] != COMPUTED:
            said += [f"What sets it apart: {f.words}. {f.help}" for f in self.findings[:1]]
        return tuple(f"{s}." for s in said)

    @property
    def _still_changing(self) -> bool:
        """Whether nothing but the end of the run keeps it from being inside."""
        if self.region is not Region.NEAR or self.failing is None:
            return False
        return self.failing <= reliable_share(self.method)

    def as_json(self) -> dict[str, Any]:
        """Return the verdict for a file."""
        return {
            "region": str(self.region),
            "method": self.method,
            "failing": self.failing,
            "sentences": list(self.sentences),
            "findings": [asdict(f) for f in self.findings],
            "evidence": dict(self.evidence),
            "basis": self.basis,
        }


MOST = 2
"""Stresses that are named."""
