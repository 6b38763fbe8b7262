"""What all steps of a mask alignment share: the bench, spots, how many frames are left, what was said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.spot_camera import SpotCamera, SpotLook
from calibration_routines.options import Size, problems_of
from instrument.files.errors import BenchError, SettingsError
from recon.base.declare import RARE, option
from recon.holography import Display
from recon.holography.spots import PoseProbe

Progress = Callable[[str, int], object]
ALIGNMENT_FILE = "alignment.json"
"""Where the command line writes it."""


class AlignmentFailedError(BenchError):
    """The mask's pose was not found; the text says at which step and what was seen."""

    exit_code = 1


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings:
    """How far and how carefully to search."""

    reach: float = option(72.0, unit="mask px", above=0, help="Largest shift to look for, mask pixels.")
    depth_um: float = option(1000.0, unit="um", above=0, help="Largest distance to look for.")
    moves: int = option(4, least=0, label="Stage moves", help="Stage moves at most; 0: nothing moves.")
    max_frames: int = option(
        100, least=1, label="Frames", help="Frames at most: gives up rather than take more."
    )
    division: Size = option(
        Size(3, 5),
        flags=("--sections",),
        metavar="ROWSxCOLUMNS",
        parse=Size.of,
        label="Sections",
        help="Sections of the SLM, whose displacement is measured one by one.",
    )
    slm_calibration: Path | None = option(
        None,
        metavar="FILE",
        label="SLM calibration",
        help="Look-up table and flatness, from calibrate slm.",
        default_words="none: an ideal SLM",
    )
    roll_mrad: float = option(
        7.0, unit="mrad", above=0, label="Rotation", help="Largest rotation to look for.", group=RARE
    )
    scale: float = option(
        0.003, above=0, label="Scale error", help="Largest scale error to look for.", group=RARE
    )
    tilt_mrad: float = option(
        5.0,
        unit="mrad",
        above=0,
        label="Tilt",
        help="Typical tilt of a mask put in by hand: spots hardly feel it, so it is taken for likely.",
        group=RARE,
    )
    spots: int = option(128, least=1, help="Spots in a search picture.", group=RARE)
    section_pictures: int = option(
        8, least=1, help="Pictures of section spots in their last measurement.", group=RARE
    )
    refinements: int = option(
        4, least=1, help="Pictures in the last measurement of depth, tilts and brightness.", group=RARE
    )
    out: Path | None = option(
        None,
        flags=("--out", "-o"),
        metavar="FILE",
        label="File",
        help="Where the alignment goes (.json); a picture goes beside it.",
        default_words=f"{ALIGNMENT_FILE}; in the window dated, beside the runs",
    )
    overwrite: bool = option(False, flags=("--force",), help="Overwrite files that exist.")

    def __post_init__(self) -> None:
        if problems := problems_of(self):
            raise SettingsError(problems)

    @property
    def last_frames(self) -> int:
        """Frames of the last measurements, sections and pose; kept in reserve by what comes before."""
        return self.section_pictures + self.refinements + 2


class AlignmentSession:
    """One alignment in progress.

    Parameters
    ----------
    io : DisplayBench
    display : Display
        What is known of the display; its displacement is not used.
    settings : AlignmentSettings
    progress : callable, optional
        ``progress(words, frames_taken)``.
    on_look : callable, optional
        Called with every picture of spots.
    """

    def __init__(
        self,
        io: DisplayBench,
        display: Display,
        settings: AlignmentSettings,
        progress: Progress | None = None,
        on_look: Callable[[SpotLook], object] | None = None,
    ) -> None:
        self.io = io
        self.display = replace(display, displacement=None)
        self.settings = settings
        self.spots = SpotCamera(io, self.display, before_frame=self._enough, on_look=on_look)
        self.probe = PoseProbe(self.spots.maker)
        self.log: list[str] = []
        self.efficiencies: list[tuple[int, float]] = []
        self._progress = progress

    @property
    def frames_left(self) -> int:
        """Frames that may still be taken."""
        return self.settings.max_frames - self.io.frames

    def register(self) -> None:
        """Blank SLM: register the camera, and learn how bright the mean intensity is."""
        self.spots.register()
        self.say(f"camera registered to {self.spots.camera.residual_px:.2f} px")

    def check(self, efficiency: float, floor: float = 0.3) -> None:
        """Fail where spots are too dim to be believed."""
        if not efficiency > floor:
            raise AlignmentFailedError(
                f"Alignment failed: spots reach {100 * efficiency:.0f} % of the model's brightness "
                f"({100 * floor:.0f} % needed). Check mask, wavelength and focal length in [display], bring "
                "the mask closer by its coarse marks, or widen the search."
            )

    def say(self, words: str) -> None:
        """Keep words for the record, and tell them."""
        self.log.append(words)
        self.tell(words)

    def tell(self, words: str) -> None:
        """Tell what is going on."""
        if self._progress is not None:
            self._progress(words, self.io.frames)

    def _enough(self) -> None:
        if self.frames_left <= 0:
            raise AlignmentFailedError(
                f"Alignment gave up after {self.io.frames} frames. {self.log[-1] if self.log else ''}"
            )
