"""Procedures besides the sweeps for the camera: angular response, the diffuser's surface, bead slides."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration_routines.optics.angular import (
    AngularSweep,
    check_angular,
    farthest_um,
    measure_angular_response,
)
from calibration_routines.optics.angular_response import CUT_OFF, AngularResponse
from calibration_routines.optics.beads import (
    BIN_FIRST,
    MANY_PX,
    BeadCalibration,
    BeadSlides,
    bench_geometry,
    calibrate_beads,
    needed_geometry,
    photograph_slides,
    window_for,
)
from calibration_routines.optics.dpc import DiffuserSurface, DpcSetup, dpc_optics, dpc_plan, measure_diffuser
from calibration_routines.optics.photograph import expose_scene, photograph, photograph_plan
from calibration_routines.procedure import (
    Listener,
    Outcome,
    Outlook,
    home_if_needed,
    outlook_of,
    under_control,
)
from calibration_routines.psf.calibration_figures import response_figure, surface_figure
from instrument.bench.bench import Bench
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError, FileError, SettingsError
from instrument.files.figures import save_figure
from instrument.files.images import write_image
from instrument.plan import check
from instrument.runs.acquire import abilities_of
from instrument.runs.folder import dated_name, free_name
from instrument.runs.run_control import RunControl

PHOTOGRAPH_FILE = "photograph.tif"


@dataclass(frozen=True, slots=True, kw_only=True)
class AngularProcedure:
    """Measure the sensor's angular response; see :class:`AngularSweep`.

    ``z_um`` None: the farthest distance from which the stage spans the angles.
    """

    z_um: float | None = None
    largest_deg: float = 45.0
    step_deg: float = 3.0
    emission: str = "pinhole"
    average: int = 4
    dark_frames: int = 4

    def __post_init__(self) -> None:
        self._sweep(1.0 if self.z_um is None else self.z_um).points()

    def sweep(self, bench: Bench) -> AngularSweep:
        """Return what is measured, the distance filled in."""
        return self._sweep(farthest_um(bench, self.largest_deg) if self.z_um is None else self.z_um)

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold every place against the stage's limits."""
        sweep = self.sweep(bench)
        points = sweep.points()
        plan = check_angular(bench, sweep, folder or bench.config.data_folder)
        reason = (
            f"{len(points.points_um)} places at z = {sweep.z_um / 1e3:.4g} mm, up to "
            f"+-{self.largest_deg:g} degrees along x and y"
        )
        farthest = "" if self.z_um is not None else ", the farthest from which the stage spans the angles"
        return outlook_of(bench, plan, folder, [reason + farthest])

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Home, move the source, and save the response with its picture in the run's folder."""
        heard, sweep = listener or Listener(), self.sweep(bench)
        check_angular(bench, sweep, folder)
        with under_control(bench, control) as control:
            home_if_needed(bench, heard)
            heard.step("moving the source")
            response, file = measure_angular_response(
                bench,
                sweep,
                folder,
                on_progress=heard.frame,
                on_exposures=heard.exposures,
                control=control,
            )
        return response_outcome(response, file)

    def _sweep(self, z_um: float) -> AngularSweep:
        return AngularSweep(
            z_um,
            self.largest_deg,
            self.step_deg,
            self.emission,  # type: ignore[arg-type]  # any other text is refused there in words
            self.average,
            self.dark_frames,
        )


def response_outcome(response: AngularResponse, file: Path) -> Outcome:
    """Draw a response beside its file, and say what it is."""
    picture = file.with_suffix(".png")
    save_figure(response_figure(response), picture)
    return Outcome(
        verdict=tuple(response_lines(response)),
        good=not response.findings,
        runs=(file.parent,),
        files=(file, picture),
        result=response,
    )


def response_lines(response: AngularResponse) -> list[str]:
    """Return the cut-offs and the quality of a response in sentences."""
    lines = []
    for name, curve in (("x", response.along_x), ("y", response.along_y)):
        words = []
        for sign, angle in zip("-+", curve.cut_offs_deg(), strict=True):
            end = curve.angles_deg[0 if sign == "-" else -1]
            value = curve.response[0 if sign == "-" else -1]
            words.append(
                f"{sign}{angle:.1f} degrees"
                if angle is not None
                else f"not reached on the {sign} side ({value:.0%} at {end:+.1f} degrees)"
            )
        lines.append(f"Cut-off along {name} ({CUT_OFF:.0%} of the axis): {' and '.join(words)}")
    return lines + [f"Quality: {finding}" for finding in response.findings]


@dataclass(frozen=True, slots=True)
class DpcProcedure:
    """Measure the diffuser's surface by differential phase contrast."""

    setup: DpcSetup

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold the half circles against the LED array and the objective."""
        if bench.led_array is None:
            raise BenchError(f"{bench.label} has no [led_array].")
        folder = folder or bench.config.data_folder
        optics = dpc_optics(bench, self.setup)
        plan = dpc_plan(bench.led_array, self.setup, bench.camera.exposure_ms)
        check(plan, abilities_of(bench, folder))
        lit = len(plan.parts[1].light[0].leds)
        reason = (
            f"4 half circles of {lit} LEDs up to NA {optics.illumination_na:.3g} (the objective's "
            f"{self.setup.objective_na:g}, and beyond, so that deflected light is not only lost). "
            f"Pixels are {optics.pitch_um:.3g} um in the sample, at {optics.wavelength_nm:g} nm."
        )
        return outlook_of(bench, plan, folder, [reason])

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Photograph the halves and save the surface with its picture in the run's folder."""
        heard = listener or Listener()
        with under_control(bench, control) as control:
            heard.step("half circles")
            surface, file = measure_diffuser(
                bench, self.setup, folder, on_progress=heard.frame, control=control
            )
        return surface_outcome(surface, file)


def surface_outcome(surface: DiffuserSurface, file: Path) -> Outcome:
    """Draw a surface beside its file, and say what it is."""
    picture = file.with_suffix(".png")
    save_figure(surface_figure(surface), picture)
    return Outcome(
        verdict=(surface_line(surface),),
        good=True,
        runs=(file.parent,),
        files=(file, picture),
        result=surface,
    )


def surface_line(surface: DiffuserSurface) -> str:
    """Return a surface's figures of merit in a line."""
    figures = surface.figures
    return (
        f"Height       {figures['height_rms_um']:.3g} um rms; slope {figures['slope_mean_deg']:.3g} degrees "
        f"on average; deflection half width {figures['deflection_hwhm_deg']:.3g}, largest "
        f"{figures['deflection_largest_deg']:.3g} degrees"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class BeadProcedure:
    """Photograph bead slides and recover PSFs from them, without a stage.

    The slide is moved in between by the simulated bench, or by the operator, who is asked.

    Attributes
    ----------
    slides : BeadSlides
    out : Path, optional
        The calibration's folder; None: a dated name beside the runs.
    overwrite : bool
        Replace a calibration that exists.
    """

    slides: BeadSlides
    out: Path | None = None
    overwrite: bool = False

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse what cannot be solved because the optics are not known, or saved."""
        self._refuse_existing()
        slides = self.slides
        geometry = bench_geometry(bench, slides)
        needed_geometry(geometry)
        rows, columns = slides.solver.grid
        frame = bench.camera.frame_shape[0] // slides.binning, bench.camera.frame_shape[1] // slides.binning
        height, width = window_for(slides, geometry, frame)
        note = (BIN_FIRST,) if frame[0] * frame[1] > MANY_PX else ()
        frames = slides.images * (slides.average + 4)
        return Outlook(
            (
                f"{slides.images} photographs of {slides.average} frames, each with 4 dark frames: {frames} "
                "frames; the slide is moved in between",
                f"{rows} x {columns} PSFs of {height} x {width} pixels at z = {slides.z_um / 1e3:g} mm, over "
                f"{slides.solver.reach:.0%} of the field of {frame[0]} x {frame[1]} pixels",
                *note,
            )
        )

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Photograph, solve, and save the calibration."""
        heard = listener or Listener()
        self._refuse_existing()
        geometry = bench_geometry(bench, self.slides)
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds)}
        with under_control(bench, control) as control:
            heard.step("photographing bead slides")
            taken = photograph_slides(
                bench, self.slides, folder, ask=bench.ask, on_progress=heard.frame, control=control
            )
            heard.step("blind deconvolution")

            def solving(_words: str, done: float) -> None:
                control.check()
                heard.share(done, 1.0)

            solved = calibrate_beads(taken, self.slides, geometry, provenance=facts, progress=solving)
        out = self.out or free_name(folder or bench.config.data_folder, dated_name("bead calibration"))
        path = save_calibration(solved.calibration, out, overwrite=self.overwrite)
        return Outcome(verdict=tuple(bead_lines(solved)), good=True, calibration=path, result=solved)

    def _refuse_existing(self) -> None:
        if self.out is not None and self.out.exists() and not self.overwrite:
            raise FileError(self.out, "exists already.", "Choose another name, or replace it with --force.")


def bead_lines(done: BeadCalibration) -> list[str]:
    """Return what the bead images gave, in lines."""
    result = done.result
    misfits, between = (", ".join(f"{m:.3f}" for m in ms) for ms in (result.misfits, result.point_misfits))
    return [
        f"Beads found: {', '.join(map(str, done.calibration.quality['beads_found']))}",
        f"Misfit by rank: {misfits} with beads on the pixel grid ({result.stopped});",
        f"  {between} with beads between pixels, PSFs of rank {result.rank}",
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographProcedure:
    """Photograph the lit scene for a reconstruction: exposure, frames, dark frames taken off.

    Attributes
    ----------
    exposure_ms : float, optional
        None: found, so that nothing saturates.
    average, dark_frames : int
        Frames with and without light; all are stored.
    binning : int
        In software, on top of the camera's; the same as the calibration's.
    """

    exposure_ms: float | None = None
    average: int = 4
    dark_frames: int = 4
    binning: int = 1

    def __post_init__(self) -> None:
        problems = [
            (name, f"{name} must be at least 1, not {getattr(self, name)}")
            for name in ("average", "dark_frames", "binning")
            if getattr(self, name) < 1
        ]
        if self.exposure_ms is not None and not 0 < self.exposure_ms < np.inf:
            problems.append(("exposure_ms", f"the exposure is above 0 ms, not {self.exposure_ms:g}"))
        if problems:
            raise SettingsError(problems)

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold exposure, frames and disk against the bench."""
        folder = folder or bench.config.data_folder
        present_ms = self.exposure_ms or bench.camera.exposure_ms
        low, high = bench.camera.exposure_limits_ms
        if not low <= present_ms <= high:
            words = f"{present_ms:g} ms is outside the camera's {low:g} to {high:g} ms"
            raise SettingsError([("exposure_ms", words)])
        plan = photograph_plan(present_ms, self.average, self.dark_frames)
        check(plan, abilities_of(bench, folder))
        found = "as given" if self.exposure_ms is not None else "found at the start"
        return outlook_of(bench, plan, folder, [f"The exposure is {found}."])

    def carry_out(
        self,
        bench: Bench,
        folder: Path | None = None,
        *,
        control: RunControl | None = None,
        listener: Listener | None = None,
    ) -> Outcome:
        """Photograph, and write the picture that ``reconstruct`` takes into the run's folder."""
        heard = listener or Listener()
        with under_control(bench, control) as control:
            exposure_ms = self.exposure_ms
            if exposure_ms is None:
                heard.step("finding the exposure")
                exposure_ms = expose_scene(bench).exposure_ms
                control.check()
            heard.step("photographing")
            taken = photograph(
                bench,
                exposure_ms,
                folder,
                average=self.average,
                dark_frames=self.dark_frames,
                binning=self.binning,
                on_progress=heard.frame,
                control=control,
            )
        file = taken.run.path / PHOTOGRAPH_FILE
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds), "binning": self.binning}
        write_image(file, taken.measurement, facts | {"exposure_ms": taken.exposure_ms, "dark": "taken off"})
        words = f"Photograph: {taken.exposure_ms:.4g} ms, {taken.saturated_pixels} saturated pixels"
        return Outcome(
            verdict=(words,),
            good=taken.saturated_pixels == 0,
            runs=(taken.run.path,),
            files=(file,),
            result=taken,
        )
