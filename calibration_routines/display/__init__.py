"""SLM response, mask alignment, hologram photographs; here what a command declares before it imports them."""

from dataclasses import dataclass

from recon.base.declare import option

HOLOGRAM, PHOTOGRAPHED = "hologram", "Photographed, with --capture"
"""What options of photographs are about, and their heading."""


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """How a hologram is photographed."""

    average: int = option(4, least=1, help="Photographs a frame.", applies=(HOLOGRAM,), group=PHOTOGRAPHED)
    refine: int = option(
        0,
        least=0,
        help="Rounds with the camera in the loop; writes PATTERN-refined.png.",
        applies=(HOLOGRAM,),
        group=PHOTOGRAPHED,
    )
