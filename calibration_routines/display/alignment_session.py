"""What all steps of a mask alignment share: the bench, spots, how many frames are left, what was said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.spot_camera import SpotCamera, SpotLook
from instrument.files.errors import BenchError, SettingsError
from recon.base.declare import option
from recon.base.option_text import size
from recon.holography import Display
from recon.holography.pose_fit import PoseProbe

Progress = Callable[[str, int], object]


class AlignmentFailedError(BenchError):
    """The mask's pose was not found; the text says at which step and what was seen."""

    exit_code = 1


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """How far and how carefully to search.

    Attributes
    ----------
    reach : float
        Largest shift to look for, mask pixels.
    depth_um : float
        Largest distance to look for.
    roll_mrad, scale : float
        Largest rotation and scale error to look for.
    tilt_mrad : float
        Typical tilt of a mask put in by hand: spots hardly feel it, so that it is also taken for likely.
    spots : int
        In a search picture.
    max_frames : int
        Give up rather than take more.
    moves : int
        Stage moves at most; 0 keeps the stage where it is.
    division : (int, int)
        Rows and columns of the sections whose displacement is measured one by one.
    section_pictures : int
        Pictures of section spots in their last measurement.
    refinements : int
        Pictures of probe spots in the last measurement of depth, tilts and brightness.
    """

    reach: float = option(72.0, help="Largest shift to look for, mask pixels.", above=0)
    depth_um: float = option(1000.0, help="Largest distance to look for.", unit="um", above=0)
    roll_mrad: float = 7.0
    scale: float = 0.003
    tilt_mrad: float = 5.0
    spots: int = 128
    max_frames: int = option(100, help="Give up rather than take more.", least=1)
    moves: int = option(4, help="Stage moves at most; 0: nothing moves.", least=0)
    division: tuple[int, int] = option(
        (3, 5),
        help="Of the SLM, measured one by one.",
        default_words="3x5",
        flags=("--sections",),
        metavar="ROWSxCOLUMNS",
        parse=size,
    )
    section_pictures: int = 8
    refinements: int = 4

    def __post_init__(self) -> None:
        problems = [
            (name, f"{name} must be a finite number above 0, not {getattr(self, name):g}")
            for name in ("reach", "depth_um", "roll_mrad", "scale", "tilt_mrad")
            if not 0 < getattr(self, name) < float("inf")
        ]
        problems += [
            (name, f"{name} must be at least {least}, not {getattr(self, name)}")
            for name, least in (
                ("spots", 1),
                ("max_frames", 1),
                ("moves", 0),
                ("section_pictures", 1),
                ("refinements", 1),
            )
            if getattr(self, name) < least
        ]
        if min(self.division) < 1:
            words = f"the SLM has at least one row and one column of sections, not {self.division}"
            problems.append(("division", words))
        if problems:
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
