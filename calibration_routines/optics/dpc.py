"""A diffuser's phase and height by differential phase contrast with the LED array (Kuo 2020, A.2).

The diffuser is the sample of a microscope lit by half circles of the array; four images and dark frames give
the phase (:mod:`recon.analysis.dpc`), the material's index the height, and the height the histograms of
slope and deflection that tell a diffuser's quality.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibration_routines.options import Checked
from calibration_routines.planned import outlook_of
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.analysis import DarkModel, ambient_findings, dark_model, full_scale, light_of
from calibration_routines.psf.exposure import expose_light
from calibration_routines.psf.stage_fit import MAX_PLACE_DRIFT_PX
from calibration_routines.psf.sweep_plan import DARK
from calibration_routines.purpose import CalibrationError, Purpose, completed
from calibration_routines.routine import Routine
from calibration_routines.scatter import Scatter, compare, pooled, scatter_of
from drivers.led_array import LedArray
from instrument.bench.bench import Bench
from instrument.files.atomic import named_by_worth, whole_file
from instrument.files.errors import BenchError
from instrument.files.figures import save_figure
from instrument.files.record import RecordFormat, plain
from instrument.plan import OFF, Light, Part, Plan, check
from instrument.plan.led_shapes import HalfCircle
from instrument.runs.acquire import abilities_of
from instrument.runs.results import SURFACE_FILE
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.analysis.dpc import SIDES, DpcOptics, deflections_deg, phase_from_halves, slopes_deg
from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_mean
from recon.base.declare import RARE, option

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OVERFILL = 1.3
"""Aperture of the lit half circles over the objective's. More than 1, so that deflected light enters on one
side as it leaves on the other (docs/decisions/0016-dpc.md)."""
LEAST_LEDS = 24
"""Inside the objective's aperture: fewer, and slopes show in steps, as single LEDs cross the pupil's edge."""
BANDS = ("red", "green", "blue")
HEIGHT_FILE = "height_um.npy"
AGAIN = "again"
"""Label of the first half's frames once more, after the others."""
_COARSE = 4  # pixels along a block's side
_SHAKEN_PX = 1.0  # smooth pictures that shake by less change by less than 1 %
_TARGET = 0.6  # of full scale: halves differ in brightness where the sample deflects
_COLOURS = ("#00798c", "#d1495b")
_EDGE_QUANTILE = 0.999  # the largest deflection, less the outliers that noise makes


@dataclass(frozen=True)
class DpcSetup(Checked):
    """The microscope and the sample."""

    objective_na: float = option(
        MISSING,
        above=0,
        below=0.95,
        flags=("--na",),
        label="Objective's NA",
        help="Numerical aperture of the objective.",
    )
    magnification: float = option(MISSING, above=0, help="From the sample to the camera.")
    index: float = option(
        1.58,
        above=1,
        below=4,
        label="Refractive index",
        help="Refractive index of the diffuser at the wavelength, in air; polycarbonate: 1.58.",
    )
    band: str = option("green", choices=BANDS, label="LEDs", help="Which LEDs to light.")
    average: int = option(8, least=1, label="Frames a half", help="Frames a half circle, averaged.")
    dark_frames: int = option(8, least=1, help="Dark frames, averaged.", group=RARE)


@dataclass(frozen=True)
class DiffuserSurface:
    """What was measured."""

    height_um: Float32Array
    """(height, width): relative to the plane that fits best."""
    phase_rad: Float32Array
    """(height, width)."""
    pitch_um: float
    """In the sample."""
    slope_deg: Float64Array
    deflection_deg: Float64Array
    """(height, width): magnitudes of the surface's slope, and of a normal ray's deflection."""
    bench: str = ""
    simulated: bool = False

    @property
    def figures(self) -> dict[str, float]:
        """Figures of merit as the dissertation gives them (A.2): slope and deflection in degrees."""
        return {
            "height_rms_um": float(self.height_um.std()),
            "slope_mean_deg": float(self.slope_deg.mean()),
            "slope_rms_deg": float(np.sqrt((self.slope_deg**2).mean())),
            "deflection_hwhm_deg": half_width_deg(self.deflection_deg),
            "deflection_largest_deg": float(np.quantile(self.deflection_deg, _EDGE_QUANTILE)),
        }


def half_width_deg(deflection_deg: Float64Array) -> float:
    """Return the half width at half maximum of the deflection along one axis, degrees.

    A Gaussian's, from the root mean square of both axes: a diffuser's data sheet gives this width.
    """
    rms_axis = float(np.sqrt((deflection_deg**2).mean() / 2))
    return rms_axis * float(np.sqrt(2 * np.log(2)))


def dpc_plan(array: LedArray, setup: DpcSetup, exposure_ms: float) -> Plan:
    """Return the plan: the four halves, and the first one again, between two halves of the dark frames.

    Raises BenchError when the array does not reach beyond the objective's aperture.
    """
    na, rgb = _illumination_na(array, setup), _rgb(setup)
    late = setup.dark_frames // 2
    before, after = (
        (Part(label=DARK, light=(OFF,), exposures_ms=(exposure_ms,), repeats=n),) if n else ()
        for n in (setup.dark_frames - late, late)
    )
    shown = {side: side for side in SIDES} | {AGAIN: SIDES[0]}
    lit = (
        Part(
            label=label,
            light=(Light.of(HalfCircle(side, na).on(array, rgb)),),
            exposures_ms=(exposure_ms,),
            repeats=setup.average,
        )
        for label, side in shown.items()
    )
    return Plan(label="dpc", parts=(*before, *lit, *after))


@dataclass(frozen=True, slots=True)
class DpcRecord:
    """What the surface is computed with besides the frames."""

    setup: DpcSetup
    optics: DpcOptics
    exposure_ms: float
    bench: str
    simulated: bool


DPC = Purpose(
    DpcRecord,
    "dpc_setup.json",
    SURFACE_FILE,
    RecordFormat(
        "diffuserbench dpc setup",
        "run of calibrate dpc",
        restore="The frames beside it are not touched.",
        unnamed_before=True,
    ),
)
_RESULT = RecordFormat("diffuserbench dpc", "diffuser's surface")


def _finish(run: Run, _bench: Bench | None, _control: RunControl, listener: Listener) -> Outcome:
    """Compute the surface from a complete run, and save it with its picture in its folder.

    Raises CalibrationError when a half saturates.
    """
    listener.step("analysing the surface")
    record = DPC.read(run.path)
    optics, index = record.optics, record.setup.index
    dark = dark_model(run)
    with DPC.analysed(run.path):
        halves, scatter = _halves(run, dark)
    first, shaken = halves[SIDES[0]], scatter.motion_px > _SHAKEN_PX
    findings = (  # each half is brought to its own mean: flicker is none
        *replace(scatter, flicker=0.0, motion_px=shaken * scatter.motion_px).findings("half", put_back=False),
        *ambient_findings(dark.brightening_per_ms * record.exposure_ms / max(float(first.mean()), 1e-9)),
        *(_moved(run, dark, first) if scatter.averages == len(SIDES) else _unlike(record.setup.average)),
    )
    phase = phase_from_halves(halves, optics)
    height = (phase * (1e-3 * optics.wavelength_nm / (2 * np.pi * (index - 1)))).astype(np.float32)
    slope = slopes_deg(height, optics.pitch_um)
    deflection = deflections_deg(slope, index)
    surface = DiffuserSurface(
        height, phase, optics.pitch_um, slope, deflection, record.bench, record.simulated
    )
    file = DPC.place(run.path, doubted=bool(findings))
    height_file = named_by_worth(run.path / HEIGHT_FILE, doubted=bool(findings))
    with whole_file(height_file) as heights:
        np.save(heights, surface.height_um)
    picture = file.with_suffix(".png")
    facts = {
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        **plain(record),
        "height_file": height_file.name,
        "pitch_um": surface.pitch_um,
        "figures": surface.figures,
        "scatter": plain(scatter),
        "findings": list(findings),
    }
    _RESULT.write(file, facts)
    save_figure(surface_figure(surface), picture)
    return Outcome(
        verdict=(*(f"Quality: {finding}" for finding in findings), surface_line(surface)),
        good=not findings,
        runs=(run.path,),
        files=(file, picture),
        result=surface,
    )


def dpc_optics(bench: Bench, setup: DpcSetup) -> DpcOptics:
    """Return the optics that the phase is computed with.

    Raises BenchError as :func:`dpc_plan`.
    """
    array = _array(bench)
    sines = array.led_na
    inside = np.hypot(sines[:, 0], sines[:, 1]) <= setup.objective_na
    lit = np.mean([np.count_nonzero(inside & (sines[:, k] != 0)) for k in (0, 1)]) / np.count_nonzero(inside)
    return DpcOptics(
        pitch_um=bench.camera.pixel_pitch_um * bench.camera.binning / setup.magnification,
        wavelength_nm=array.wavelengths_nm[BANDS.index(setup.band)],
        objective_na=setup.objective_na,
        illumination_na=_illumination_na(array, setup),
        lit_share=float(lit),
    )


def _illumination_na(array: LedArray, setup: DpcSetup) -> float:
    radius = np.hypot(array.led_na[:, 0], array.led_na[:, 1])
    inside = np.count_nonzero(radius <= setup.objective_na)
    if inside < LEAST_LEDS or radius.max() <= 1.1 * setup.objective_na:
        raise BenchError(
            f"The LED array reaches an aperture of {radius.max():.3g} with {inside} LEDs inside the "
            f"objective's {setup.objective_na:g}; wanted are {LEAST_LEDS} inside or more, and a tenth "
            "beyond. Change the array's distance, or the objective."
        )
    return float(min(OVERFILL * setup.objective_na, radius.max() * (1 + 1e-9)))


def _array(bench: Bench) -> LedArray:
    if bench.led_array is None:
        raise BenchError(f"{bench.config.label} has no [led_array]: differential phase contrast needs one.")
    return bench.led_array


def _rgb(setup: DpcSetup) -> tuple[int, int, int]:
    red, green, blue = (255 if band == setup.band else 0 for band in BANDS)
    return red, green, blue


def _halves(run: Run, dark: DarkModel) -> tuple[dict[str, Float32Array], Scatter]:
    halves, scatters = {}, []
    for side in SIDES:
        if np.any((run.images(side) >= full_scale(run)).any(axis=0) & ~dark.hot):
            raise CalibrationError(f"The half {side!r} saturates; lower the light. The run is in {run.path}.")
        halves[side], scatter = _steady(run, side, dark)
        scatters.append(scatter)
    return halves, pooled(scatters)


def _steady(run: Run, label: str, dark: DarkModel) -> tuple[Float32Array, Scatter]:
    """Return a half's mean, and how its frames scatter.

    Halves are so smooth that noise hides where single pixels lie: blocks of them tell, but not well enough to
    put frames onto one another (half a pixel of shaking then changed a surface by 5 %, left as it is by 0.2).
    """
    steady = light_of(run, [step.index for step in run.steps(label)], dark)
    scatter, _ = scatter_of(block_mean(steady.frames, _COARSE))
    return steady.mean, scatter.on_pixels(_COARSE)


def _unlike(frames: int) -> tuple[str, ...]:
    """Return what is to be said of halves whose frames are not found again in one another."""
    if frames < 2:
        return ()
    return (
        "frames of one half are not found again in one another: the picture moves or shakes by pixels, or "
        "the light is too little for the sample's contrast. Clamp sample, objective and camera; give more "
        "light.",
    )


def _moved(run: Run, dark: DarkModel, first: Float32Array) -> tuple[str, ...]:
    """Return what the first half, taken again, says of the time between; nothing of runs without it."""
    steps = run.steps(AGAIN)
    if not steps:
        return ()
    change = compare(*(block_mean(half, _COARSE) for half in (_steady(run, AGAIN, dark)[0], first)))
    away_px = _COARSE * change.shift_px
    if away_px <= MAX_PLACE_DRIFT_PX:
        return ()
    where = f"lies {away_px:.1f} pixels from where it was"
    seen = where if np.isfinite(away_px) else "is another picture"
    return (
        f"the {SIDES[0]} half, taken again after the others, {seen} (up to {MAX_PLACE_DRIFT_PX:g} expected): "
        "sample, objective or camera moved, and halves differ by that. Clamp them, and take it again.",
    )


# Procedure -------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class DpcProcedure(Procedure):
    """Measure the diffuser's surface by differential phase contrast."""

    setup: DpcSetup

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold the half circles against the LED array and the objective."""
        folder = folder or bench.config.data_folder
        optics = dpc_optics(bench, self.setup)
        plan = dpc_plan(_array(bench), self.setup, bench.camera.exposure_ms)
        check(plan, abilities_of(bench, folder))
        lit = len(plan.parts[1].light[0].leds)
        reason = (
            f"4 half circles of {lit} LEDs up to NA {optics.illumination_na:.3g} (the objective's "
            f"{self.setup.objective_na:g}, and beyond, so that deflected light is not only lost). "
            f"Pixels are {optics.pitch_um:.3g} um in the sample, at {optics.wavelength_nm:g} nm."
        )
        return outlook_of(bench, plan, folder, [reason])

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Photograph the halves and save the surface with its picture in the run's folder."""
        listener.step("half circles")
        array, setup = _array(bench), self.setup
        first = HalfCircle(SIDES[0], _illumination_na(array, setup)).on(array, _rgb(setup))
        try:
            found = expose_light(bench, lambda: array.set_pattern(first), target=_TARGET, dimmest=_TARGET)
        finally:
            array.off()
        optics, exposure_ms = dpc_optics(bench, setup), found.exposure_ms
        record = DpcRecord(setup, optics, exposure_ms, bench.label, bool(bench.simulated_kinds))
        plan = dpc_plan(array, setup, exposure_ms)
        runner = DPC.prepare(bench, plan, folder, record, control, listener)
        return _finish(completed(runner.execute()), bench, control, listener)


def surface_line(surface: DiffuserSurface) -> str:
    """Return a surface's figures of merit in a line."""
    figures = surface.figures
    return (
        f"Height       {figures['height_rms_um']:.3g} um rms; slope {figures['slope_mean_deg']:.3g} degrees "
        f"on average; deflection half width {figures['deflection_hwhm_deg']:.3g}, largest "
        f"{figures['deflection_largest_deg']:.3g} degrees"
    )


def surface_figure(surface: DiffuserSurface) -> Figure:
    """Draw a diffuser's height, a cut, and histograms of slope and deflection (Kuo 2020, Fig. A.1)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.2, 1), height_ratios=(1.6, 1))
    height, width = (n * surface.pitch_um for n in surface.height_um.shape)
    axes = figure.add_subplot(grid[0, 0])
    shown = axes.imshow(surface.height_um, extent=(0, width, height, 0), cmap="viridis")
    axes.axhline(height / 2, color="white", ls="--", lw=0.8)
    axes.set(xlabel="x in the sample, µm", ylabel="y, µm", title="Height above the best plane")
    figure.colorbar(shown, ax=axes, label="height, µm")
    axes = figure.add_subplot(grid[1, 0])
    cut = surface.height_um[surface.height_um.shape[0] // 2]
    axes.plot((np.arange(len(cut)) + 0.5) * surface.pitch_um, cut, color=_COLOURS[0])
    axes.set(xlabel="x in the sample, µm", ylabel="height, µm", title="Along the dashed line")
    figures = surface.figures
    slope = f"Slope: mean {figures['slope_mean_deg']:.2f}°"
    deflection = (
        f"Deflection: half width {figures['deflection_hwhm_deg']:.2f}°, largest "
        f"{figures['deflection_largest_deg']:.2f}°"
    )
    shown_of = {slope: surface.slope_deg, deflection: surface.deflection_deg}
    for row, (title, values) in enumerate(shown_of.items()):
        axes = figure.add_subplot(grid[row, 1])
        axes.hist(values.ravel(), bins=80, color=_COLOURS[row], density=True)
        axes.set(xlabel=f"{title.split(':')[0].lower()}, degrees", ylabel="density, 1/degree", title=title)
    figure.suptitle(f"Diffuser by differential phase contrast, {surface.bench}", fontsize=10)
    return figure


ROUTINES = (
    Routine(
        name="dpc",
        title="Diffuser surface (DPC)",
        help="Measure the diffuser's phase and height in an LED array microscope, with slope and deflection.",
        details="Lights the left, right, top and bottom half circles of the array. Writes dpc.json, the "
        "height (NumPy) and a picture into the run's folder.",
        options=DpcSetup,
        procedure=DpcProcedure,
        needs=("led_array",),
        tried_on="led_microscope",
        purpose=DPC,
        finish=_finish,
        examples=(
            "diffuserbench new microscope.toml --microscope",
            "diffuserbench calibrate dpc --bench microscope.toml --na 0.1 --magnification 4",
        ),
        start=lambda _: {"objective_na": 0.1, "magnification": 4.0},
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
