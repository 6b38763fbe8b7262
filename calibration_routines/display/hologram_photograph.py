"""Photograph a pattern that is on the SLM: register the camera, judge it, refine it, keep what was seen.

With the camera in the loop one hologram is improved by what the camera sees of it; never for the worse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.spot_photograph import registered_camera
from instrument.bench.config import BenchConfig
from instrument.display.alignment import Alignment
from instrument.display.bench_display import bench_display
from instrument.display.hologram import CaptureOptions, prepare_target, square, within
from instrument.display.hologram_files import CHANNELS
from instrument.files.errors import BenchError
from instrument.files.images import write_image
from instrument.files.pictures import Pixels
from instrument.files.slm_image import field_levels, is_of_mirrors, write_slm_image
from recon.arrays import Array, Float64Array
from recon.holography import Display, HologramModel, HologramOptions, Scores, Target, compute_hologram
from recon.holography.camera_map import CameraMap
from recon.holography.scores import compare, low_pass
from recon.holography.target import Band, make_band

_GAIN = 0.8  # part of what a photograph lacked that is asked for beyond
_ITERATIONS = 15  # between two photographs


@dataclass(frozen=True, slots=True)
class Capture:
    """A photographed hologram."""

    seen: Float64Array
    """(height, width): low-passed picture over the field of view (of mirrors, where the target counts), the
    axis in the middle, in units of the target's white."""
    wanted: Float64Array
    """The target on the same grid, low-passed."""
    scores: Scores
    saturated_fraction: float
    """Of the camera's pixels, at full scale in any of the photographs."""


@dataclass(frozen=True, slots=True)
class Refinement:
    """The best hologram found."""

    slm: npt.NDArray[np.complex64]
    """(1, height, width)."""
    first: Capture
    best: Capture
    """Of the hologram given and of the best one; the same where nothing was gained."""
    psnr_db: tuple[float, ...]
    """Captured, round by round; the first is the hologram given."""
    ended_by: BaseException | None = None
    """What ended it before its last round (Ctrl-C, a signal): to be raised once the best is written."""


@dataclass(frozen=True, slots=True)
class HologramCamera:
    """The bench's camera on a display whose picture is known where it lies on the sensor."""

    io: DisplayBench
    display: Display
    """With the mask's displacement where it is known."""
    camera: CameraMap
    mean_per_ms: float
    """Counts a millisecond of the mean intensity, from the registration."""
    computed: HologramOptions = field(default_factory=HologramOptions)
    """How its holograms are computed when they are refined."""

    @classmethod
    def registered(
        cls, io: DisplayBench, display: Display, computed: HologramOptions | None = None
    ) -> HologramCamera:
        """Register the camera (:func:`registered_camera`)."""
        return cls(io, display, *registered_camera(io, display), computed or HologramOptions())

    def capture(self, fields: Sequence[Array], target: Target, *, average: int = 1) -> Capture:
        """Show SLM fields one after the other, add their photographs, and compare with the target.

        The fields, complex (height, width), are time-multiplexed frames; each is photographed ``average``
        times.
        """
        io, display = self.io, self.display
        exposure_ms = io.exposure_ms(self.mean_per_ms)
        total = np.zeros(io.bench.camera.image_shape)
        saturated = np.zeros(total.shape, bool)
        for shown in fields:
            io.show(shown)
            for _ in range(average):
                frame = io.photograph(exposure_ms)
                saturated |= io.saturated(frame)
                total += frame
        band = make_band(display.slm_shape, display.factor, "alias-free")
        seen = low_passed_picture(self.camera.lags(total, band), band, display.slm_shape)
        wanted, peak = wanted_picture(target, display)
        seen, wanted = within(target.window, seen), within(target.window, wanted)
        scaled = seen * (wanted.mean() / seen.mean())
        weights = self.computed.field_weights() if target.window is None else None
        scores = compare(scaled, wanted, peak, weights)
        return Capture(scaled / peak, wanted / peak, scores, float(saturated.mean()))

    def refine(
        self,
        slm: Array,
        target: Target,
        options: CaptureOptions,
        progress: Callable[[int, float], object] | None = None,
    ) -> Refinement:
        """Photograph, let the model aim as far beyond as the picture falls short, compute again, photograph.

        The model is wrong, but it knows well which change of the pattern changes the picture how. So it is
        asked for what it showed last plus what the photograph lacked. The best pattern by photograph (in the
        fovea, where there is one) is kept:
        the result is the given one where nothing helps (its photograph decides, with the camera's noise
        averaged). Ctrl-C or a signal during a round ends it with what was best before.

        Parameters
        ----------
        slm : ndarray, complex, (1, height, width)
            Start, from :func:`recon.holography.compute_hologram` for this display.
        options : CaptureOptions
            Rounds, and photographs averaged in each.
        progress : callable, optional
            ``progress(round, psnr_db)``.
        """
        best_slm = now = np.asarray(slm, np.complex64)
        first = self.capture(list(now), target, average=options.average)
        best, measured, history = first, first, [first.scores.asked_psnr_db]
        plain = HologramModel(self.display, [target], self.computed)
        ended_by: BaseException | None = None
        try:
            for number in range(1, options.refine + 1):
                shown = plain.seen(now) / plain.peaks[0]
                aim = shown if target.window is None else np.zeros_like(shown)
                part = (...,) if target.window is None else target.window.part(aim.shape)
                aim[part] = np.maximum(shown[part] + _GAIN * (measured.wanted - measured.seen), 0)
                model = HologramModel(self.display, [replace(target, image=aim, white=1.0)], self.computed)
                now = compute_hologram(model, initial=now, iterations=_ITERATIONS, tolerance=0).slm
                measured = self.capture(list(now), target, average=options.average)
                history.append(measured.scores.asked_psnr_db)
                if measured.scores.asked_psnr_db > best.scores.asked_psnr_db:
                    best, best_slm = measured, now
                if progress is not None:
                    progress(number, history[-1])
        except (KeyboardInterrupt, SystemExit) as interruption:
            ended_by = interruption
        return Refinement(best_slm, first, best, tuple(history), ended_by)


def wanted_picture(target: Target, display: Display) -> tuple[Float64Array, float]:
    """Return the low-passed target on the smallest grid that holds it, and its peak."""
    band = make_band(display.slm_shape, display.factor, "alias-free")
    spectrum, peak = target.spectrum(display, band)
    return low_passed_picture(spectrum, band, display.slm_shape), peak


def low_passed_picture(lags: Array, band: Band, slm_shape: tuple[int, int]) -> Float64Array:
    """Return the picture of a band's lags through the eye's low-pass, the axis in the middle."""
    height, width = band.seen_shape
    half = np.zeros((height, width // 2 + 1), complex)
    rows = np.r_[0 : band.top, height - (band.kept[0] - band.top) : height]
    half[rows, : band.kept[1]] = lags
    image = np.fft.irfft2(half, (height, width)) * (height * width)
    return np.fft.fftshift(low_pass(image, slm_shape))


@dataclass(frozen=True, slots=True)
class Photographed:
    """What the camera saw of a hologram."""

    capture: Capture
    """Of the pattern given, or of the best one where it was refined."""
    refined: Refinement | None
    camera_residual_px: float
    """Of the camera's registration."""
    background_estimated: bool
    """Rather than measured with the laser off."""
    simulated: bool


def display_of_pattern(
    config: BenchConfig,
    size: tuple[tuple[int, int], float],
    facts: Mapping[str, Any],
    alignment: Alignment | None = None,
) -> Display:
    """Return the bench's display as a pattern was computed for it, by the facts beside the pattern.

    ``size`` is the SLM's shape and pitch in micrometres. Errors as ``bench_display``; BenchError for a
    pattern that needs no lens.
    """
    _require_lens(facts.get("options", {}).get("distance_mm"))
    display = bench_display(
        config, size, expansion=facts.get("expansion"), wavelength_nm=facts.get("wavelength_nm")
    )
    return display if alignment is None else alignment.of(display)


def _require_lens(distance_mm: float | None) -> None:
    if distance_mm is not None:
        raise BenchError(
            f"The pattern's picture is {distance_mm:g} mm away without a lens; photographs are registered "
            "behind the bench's Fourier lens. Show it without a photograph."
        )


def require_focus(depths_mm: Sequence[float], *, refined: bool = False) -> None:
    """Refuse to photograph planes of which none is where the camera looks, or to refine one of several.

    Raises BenchError.
    """
    told = ", ".join(f"{z_mm:g}" for z_mm in depths_mm)
    if 0.0 not in depths_mm:
        raise BenchError(
            f"The picture is in focus {told} mm behind the focal plane, where the camera does not look: show "
            "it without a photograph, or compute it without --z-mm."
        )
    if refined and len(depths_mm) > 1:
        raise BenchError(
            f"The pattern has planes {told} mm behind the focal plane: --refine would compute it anew for "
            "the one that the camera sees, and lose the others. Photograph it without."
        )


def options_of_pattern(facts: Mapping[str, Any]) -> HologramOptions:
    """Return how a pattern was computed, by the facts beside it: tone, fovea, phase levels, mirrors' light.

    Weights from a file are not kept with a pattern: the whole field counts then.
    """
    said = facts.get("options", {})
    names: tuple[str, ...] = ("fit", "srgb", "lift", "envelope", "phase_levels")
    if is_of_mirrors(facts):
        names = (*names, "mirrors", "light")
    if said.get("loss") == "spatial" and facts.get("own_weights") is False:
        names = (*names, "loss", "centre", "radius", "periphery")
    given: dict[str, Any] = {name: said[name] for name in names if name in said}
    if "centre" in given:
        given["centre"] = tuple(given["centre"])
    return HologramOptions(**given)


def target_of_pattern(picture: Pixels, display: Display, facts: Mapping[str, Any]) -> Target:
    """Return a picture as a pattern shows it: colour, size and :func:`options_of_pattern`.

    Raises BenchError where the pattern is one colour of several and the picture has none, and where none of
    its planes is in focus on the camera.
    """
    require_focus(facts.get("z_mm", [0.0]))
    if (colour := facts.get("colour")) in CHANNELS:
        if picture.ndim != 3 or picture.shape[2] != len(CHANNELS):
            raise BenchError(f"The pattern is the {colour} of a picture in colour; the one wanted is grey.")
        picture = picture[..., CHANNELS.index(colour)]
    share = facts.get("field_share", 1.0)
    return prepare_target(picture, display, options_of_pattern(facts), share=share)


def photograph_hologram(
    io: DisplayBench,
    fields: Sequence[Array],
    display: Display,
    target: Target,
    options: CaptureOptions | None = None,
    progress: Callable[[int, float], object] | None = None,
    computed: HologramOptions | None = None,
) -> Photographed:
    """Register the camera, photograph a hologram, and compare it with its target.

    ``fields``, complex (height, width), are time-multiplexed frames; one where it is to be refined. The
    display has the mask's displacement where it is known; ``progress(round, psnr_db)`` is called when
    refining.

    Raises InputError when the speckle is not recognised; DeviceError when a device fails; BenchError for a
    display without its lens, and a target that is not in focus on the camera.
    """
    _require_lens(display.distance_mm)
    require_focus([target.z_mm])
    options = options or CaptureOptions()
    seen = HologramCamera.registered(io, display, computed)
    refined = None
    if options.refine:
        refined = seen.refine(np.asarray(fields[0])[None], target, options, progress)
        capture = refined.best
    else:
        capture = seen.capture(fields, target, average=options.average)
    return Photographed(
        capture, refined, seen.camera.residual_px, io.estimates_background, bool(io.bench.simulated_kinds)
    )


def refined_path(pattern: Path) -> Path:
    """Return where the refined pattern goes, beside the one it came from."""
    return pattern.with_name(f"{pattern.stem}-refined.png")


def write_refined(pattern: Path, refined: Refinement, facts: Mapping[str, Any], binning: int) -> Path:
    """Write the refined pattern beside the one it came from, and return its path."""
    path = refined_path(pattern)
    kept = {name: fact for name, fact in facts.items() if name not in ("format", "levels_per_turn")}
    kept |= {"refined_by_camera": True, "captured_psnr_db": list(refined.psnr_db)}
    write_slm_image(path, field_levels(refined.slm[0], binning, mirrors=is_of_mirrors(facts)), kept)
    return path


def write_capture(path: Path, found: Photographed) -> None:
    """Write what was seen as an 8-bit image, square as the field, white at 255, and its metrics beside it."""
    pixels = np.clip(np.rint(square(found.capture.seen) * 255), 0, 255).astype(np.uint8)
    facts = {
        "simulated": found.simulated,
        "background": "estimated" if found.background_estimated else "measured",
        "metrics": asdict(found.capture.scores),
        "camera_residual_px": found.camera_residual_px,
    }
    write_image(path, pixels, {**facts, "low_passed": True, "white": 255})
