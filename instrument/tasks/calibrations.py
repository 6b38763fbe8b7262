"""What calibrations tell: ``analyze`` their optics, ``compare`` two, ``refocus`` one to another depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from instrument.files.atomic import require_new
from instrument.files.errors import BenchError, FileError
from instrument.files.figures import check_figure
from instrument.tasks.task import Desk, Done, Given, saying_what_is_left, task
from recon.analysis import AnalysisSettings, AskedNoise
from recon.base.declare import option
from recon.camera.grid import FAR_UM, depth_in_words
from recon.types import Calibration

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from recon.analysis.compare import Comparison


def _with_calibration(text: str) -> Path:
    """Return the folder that somebody named, which holds a calibration; FileError where it does not.

    It is looked at before what else is missing is asked for.
    """
    from instrument.files.calibration_file import find_calibration

    path = Path(text)
    find_calibration(path.expanduser())
    return path


@dataclass(frozen=True, kw_only=True)
class AnalysisFiles:
    """What an analysis reads, and what it writes."""

    calibration: Path = option(
        help="A calibration, or a run with one.",
        metavar="CALIBRATION",
        positional=True,
        group="Files",
        parse=_with_calibration,
    )
    out: Path = option(
        Path("analysis.pdf"),
        help="The page (.pdf, .png, .svg); JSON beside.",
        flags=("--out", "-o"),
        label="Result",
        group="Files",
    )
    response: Path | None = option(
        None,
        help="Instead of --cutoff-deg: angular_response.json of calibrate angular.",
        group="Files",
    )
    force: bool = option(False, help="Overwrite files that exist.", label="Overwrite", group="Files")


@dataclass(frozen=True, kw_only=True)
class RefocusOptions:
    """Which PSFs are brought to which depths, and over the field."""

    calibration: Path = option(
        help="A calibration, or a run with one.",
        metavar="CALIBRATION",
        positional=True,
        parse=_with_calibration,
    )
    z_um: tuple[float, ...] = option(
        help="Depth wanted; repeatable. inf: light that comes in parallel.",
        label="Depths",
        unit="um",
        shown_unit="mm",
        shown_factor=1000.0,
        above=0,
        infinity=FAR_UM,
    )
    out: Path = option(help="The new calibration.", metavar="FOLDER", flags=("--out", "-o"), label="Result")
    deflection_deg: float = option(
        0.25, help="How far the diffuser typically bends light.", unit="deg", above=0
    )
    response: Path | None = option(
        None,
        help="Make PSFs over the field of the one on the axis: angular_response.json of calibrate angular.",
    )
    points: int = option(3, help="Places a side, with --response.", least=1)
    figure: Path | None = option(None, help="Also a page: PSFs before and after (.png, .pdf, .svg).")
    force: bool = option(False, help="Replace what exists.", label="Overwrite")


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Which calibrations are compared."""

    old: Path = option(
        help="A calibration, or a run with one.", metavar="OLD", positional=True, parse=_with_calibration
    )
    new: Path = option(
        help="A later one of the same camera.", metavar="NEW", positional=True, parse=_with_calibration
    )
    out: Path | None = option(
        None, help="Write the figures as JSON.", metavar="FILE", flags=("--out", "-o"), label="Figures"
    )
    figure: Path | None = option(None, help="Also a page: the PSFs on one another (.png, .pdf, .svg).")
    force: bool = option(False, help="Overwrite files that exist.", label="Overwrite")


@task(
    "diffuserbench analyze runs/2026-11-21-axial",
    "diffuserbench analyze calibration --cutoff-deg 41.5,30 --out supplement.pdf",
    "diffuserbench analyze calibration --z-mm 2.5 --fall-off-deg 13 --lenslet-um 250 --wavelength-nm 520",
    "diffuserbench analyze calibration --volumes            points in default volumes, too: minutes",
    "diffuserbench analyze calibration --no-points          without reconstructions: seconds",
)
def analyze(
    desk: Desk, files: AnalysisFiles, settings: AnalysisSettings, noise: AskedNoise, given: Given
) -> Done:
    """Resolution, depth of field, field of view, conditioning, point tests and a voxel grid, on one page.

    Everything follows from the calibration's PSFs and its geometry; what they cannot tell (the sensor's
    angular cut-off, the diffuser's deflection) is given as options or named on the page as not known.
    """
    from calibration_routines.optics.angular_response import load_response
    from instrument.evaluation.analysis_figure import draw_analysis, facts
    from instrument.files.atomic import write_json
    from instrument.files.calibration_file import find_calibration, load_calibration
    from instrument.files.figures import save_figure
    from instrument.files.record import plain
    from recon.analysis import analyse
    from recon.evaluation.points_in_volumes import in_volumes
    from recon.evaluation.two_points import reached

    out, record = files.out, files.out.with_suffix(".json")
    check_figure(out, overwrite=files.force)
    require_new(record, overwrite=files.force)
    if files.response is not None and (instead := given.flags("cutoff_deg", "fall_off_deg")):
        raise BenchError(f"--response says what {' and '.join(instead)} would: give one of them.")
    measured_response = None if files.response is None else load_response(files.response)
    folder = find_calibration(files.calibration)
    if folder != files.calibration:
        desk.say(f"{'Analyses':<28}{folder}")
    with desk.step("reading"):
        measured = load_calibration(folder)
    settings = replace(settings, noise=noise)
    if measured_response is not None:
        cutoff = (measured_response.along_y.cut_off_deg, measured_response.along_x.cut_off_deg)
        settings = replace(settings, cutoff_deg=cutoff, fall_off=measured_response.fall_off())
    simulated = bool(measured.provenance.get("simulated"))
    with saying_what_is_left(out, record):
        with desk.step("analyze") as advance:
            analysis = analyse(
                measured,
                settings,
                reach=reached,
                reach_in_volumes=in_volumes,
                on_progress=lambda _what, share: advance(share * 100, 100),
            )
        title, subtitle = _titles(measured, folder)
        with desk.step("drawing"):
            figure = draw_analysis(analysis, title, subtitle, simulated=simulated)
            save_figure(figure, out)
        described = {
            "calibration": str(folder.resolve()),
            "simulated": simulated,
            "provenance": measured.provenance,
            "analysis": plain(analysis.figures()),
        }
        write_json(record, described)
    if simulated:
        desk.say("SIMULATED: the calibration comes from the simulated bench")
    for name, value in facts(analysis):
        desk.say(f"{name:<28}{value}")
    for note in analysis.notes:
        desk.warn(f"Note: {note}")
    return Done((out, record))


def _titles(calibration: Calibration, folder: Path) -> tuple[str, str]:
    """Return what the page is about and where it comes from, for readers who never saw the folder."""
    bench = str(calibration.provenance.get("bench") or "").split(" SIMULATED")[0]  # the page says that apart
    geometry, place = calibration.geometry, folder.resolve()
    name = place.parent.name if place.name == "calibration" else place.name
    depths_mm = sorted({float(z) / 1e3 for z in calibration.source_positions_um[:, 2]})
    depths = f"{len(depths_mm)} depths from {depths_mm[0]:.3g} to {depths_mm[-1]:.3g} mm"
    if len(depths_mm) == 1:
        depths = f"one depth, {depths_mm[0]:.3g} mm"
    facts = [
        f"{len(calibration.psfs)} PSF{'s' if len(calibration.psfs) > 1 else ''} at {depths}",
        f"pixels of {geometry.pixel_pitch_um:.3g} µm",
        f"diffuser to sensor {geometry.diffuser_distance_mm:.3g} mm",
        f"calibration {name}",
    ]
    return f"Optical characterisation{f': {bench}' if bench else ''}", "; ".join(facts)


@task(
    "diffuserbench compare runs/last-week runs/today",
    "diffuserbench compare before after --out bump.json --figure bump.png",
)
def compare(desk: Desk, options: CompareOptions) -> Done:
    """Say what moved between two calibrations: shift, scale, rotation, likeness, brightness.

    Ends with status 1 when a recalibration is due (the new calibration should replace the old one), else 0.
    """
    from instrument.files.atomic import write_json
    from instrument.files.calibration_file import find_calibration, load_calibration
    from instrument.files.record import plain
    from recon.analysis.compare import compare as compare_calibrations

    out, page = options.out, options.figure
    if out is not None:
        require_new(out, overwrite=options.force)
    if page is not None:
        check_figure(page, overwrite=options.force)
    folders = [find_calibration(folder) for folder in (options.old, options.new)]
    with desk.step("reading"):
        first, second = (load_calibration(folder) for folder in folders)
    for name, folder, calibration in (("Old", folders[0], first), ("New", folders[1], second)):
        desk.say(f"{name:<5}{folder}")
        if source := calibration.provenance.get("refocused_from"):
            raise FileError(
                folder,
                f"was computed from {source}, not measured: it cannot tell what moved.",
                "Compare the calibrations that were measured.",
            )
    with desk.step("comparing", 100) as advance:
        found = compare_calibrations(first, second, lambda share: advance(round(100 * share)))
    rows: list[Sequence[str]] = []
    for c in found.changes:
        turned = "?" if c.rotation_deg is None else f"{c.rotation_deg:+z.3f}°"
        figures = (f"{c.scale:.5f}", turned, f"{c.as_is:.3f}", f"{c.aligned:.3f}", f"{c.spot:.2f}")
        moved = f"{c.columns:+z.2f}, {c.rows:+z.2f}"
        rows.append((f"{c.z_um / 1e3:.4g}", moved, *figures, f"{c.brightness:.2f}"))
    desk.table(("z, mm", "shift, px (x, y)", "scale", "rotation", "alike", "aligned", "spot", "light"), rows)
    desk.say("RECALIBRATE" if found.due else "No recalibration is due")
    for reason in found.reasons:
        desk.say(f"  {reason}")
    if first.provenance.get("simulated") or second.provenance.get("simulated"):
        desk.say("SIMULATED: a calibration comes from the simulated bench")
    if out is not None:
        record = {"old": str(folders[0].resolve()), "new": str(folders[1].resolve()), **asdict(found)}
        write_json(out, plain(record))
    if page is not None:
        from instrument.files.figures import save_figure

        with desk.step("drawing"):
            save_figure(_compared_page(first, second, found), page)
    return Done(tuple(file for file in (out, page) if file is not None), good=not found.due)


def _compared_page(old: Calibration, new: Calibration, found: Comparison) -> Figure:
    """Draw both PSFs at the middle one of the compared depths, and on one another; what moved beside them."""
    import numpy as np

    from instrument.files.figures import Panel, pictures_figure
    from instrument.files.seen import as_seen
    from recon.analysis.compare import binned_alike
    from recon.camera.refocus import psf_at

    old, new, _ = binned_alike(old, new)
    z_um = found.changes[len(found.changes) // 2].z_um
    before, after = (as_seen(psf) / 255 for psf in (psf_at(old, z_um), psf_at(new, z_um)))
    where = depth_in_words(z_um)
    panels = [
        Panel("old", before, where, white=1.0),
        Panel("new", after, where, white=1.0),
        Panel("both", np.stack([before, after, after], axis=-1), "old red, new cyan, alike grey", white=1.0),
    ]
    lines = [("due", "recalibrate" if found.due else "no recalibration")]
    for c in found.changes:
        turned = "" if c.rotation_deg is None else f", turned {c.rotation_deg:+z.3f}°"
        moved = f"{c.columns:+z.2f}, {c.rows:+z.2f} px{turned}"
        lines += [(depth_in_words(c.z_um), moved), ("", f"alike {c.as_is:.3f}, aligned {c.aligned:.3f}")]
    simulated = any(c.provenance.get("simulated") for c in (old, new))
    return pictures_figure("Two calibrations compared", panels, lines, simulated=bool(simulated))


@task(
    "diffuserbench refocus runs/axial --z-mm 27.5 --out calibration-27.5",
    "diffuserbench refocus calibration --z-mm 12 --z-mm 14 --z-mm 16 --out near",
    "diffuserbench refocus calibration --z-mm 2 --response angular_response.json --points 5 --out field",
)
def refocus(desk: Desk, options: RefocusOptions, given: Given) -> Done:
    """Bring a calibration's PSFs to other depths by paraxial scaling, with the error to expect.

    Between two calibrated depths both neighbours are scaled, registered and mixed, at every place of the
    field that was calibrated (Kuo 2020, Eqs. 5.2, 5.3). `reconstruct --calibration FOLDER --z-mm Z` does the
    same by itself. With --response PSFs over the field are made of the one on the axis (Eq. 5.1).
    """
    import numpy as np

    from calibration_routines.optics.angular_response import load_response
    from instrument.files.calibration_file import find_calibration, load_calibration, save_calibration
    from recon.camera.refocus import refocus as refocused
    from recon.camera.refocus_field import extrapolations, refocus_field
    from recon.camera.two_part import is_cut, two_part

    if len(set(options.z_um)) < len(options.z_um):
        raise BenchError("--z-mm: a depth is asked for twice.")
    if "points" in given and options.response is None:
        raise BenchError("--points is how many places --response makes: give --response too.")
    if options.figure is not None:
        check_figure(options.figure, overwrite=options.force)
    folder = find_calibration(options.calibration)
    with desk.step("reading"):
        measured = load_calibration(folder)
    made, fields = [], []
    with desk.step("refocusing", len(options.z_um)) as advance:
        for done, z_um in enumerate(options.z_um, 1):
            made.append(refocused(measured, z_um, deflection_deg=options.deflection_deg))
            fields.append(refocus_field(measured, z_um))
            advance(done)
    if options.response is not None:
        response = load_response(options.response).fall_off()
        if any(is_cut(field) for field in fields):
            desk.warn(
                "Warning: The pattern of the source on the axis goes on beyond the sensor. What is not on it "
                "is dark in PSFs over the field: measure these (calibrate field), or stop the diffuser down."
            )
        with desk.step("points over the field", len(fields)) as advance:
            for place, field in enumerate(fields):
                fields[place] = two_part(field, response, points=options.points)
                advance(place + 1)
    new = replace(
        fields[0],
        psfs=np.concatenate([field.psfs for field in fields]),
        source_positions_um=np.concatenate([field.source_positions_um for field in fields]),
        quality={
            "refocused": [
                {
                    "z_um": one.z_um,
                    "from_z_um": one.from_z_um,
                    "displacement_error_um": one.displacement_error_um,
                    "expected_similarity": one.expected_similarity,
                    "similarity_within": one.similarity_within,
                }
                for one in made
            ]
        },
        provenance={
            **fields[0].provenance,
            "refocused_from": str(folder.resolve()),
            "extrapolated": extrapolations(measured, made),
        },
    )
    path = save_calibration(new, options.out, overwrite=options.force)
    if measured.provenance.get("simulated"):
        desk.say("SIMULATED: the calibration comes from the simulated bench")
    for one, field in zip(made, fields, strict=True):
        places = f" ({len(field.psfs)} places of the field)" if len(field.psfs) > 1 else ""
        desk.say(f"{depth_in_words(one.z_um)}{places}: {one}")
        if one.extrapolated:
            desk.warn(f"Warning: {one.warning}")
    if options.figure is None:
        return Done((path,))
    from instrument.files.figures import save_figure

    used = {z_um for one in made for z_um in one.from_z_um}
    with desk.step("drawing"):
        return Done((path, save_figure(_refocused_page(measured, new, used), options.figure)))


def _refocused_page(measured: Calibration, new: Calibration, used_um: set[float]) -> Figure:
    """Return the page of new PSFs beside those that they were made of, whose depths are ``used_um``."""
    from instrument.files.figures import Panel, pictures_figure
    from instrument.files.seen import as_seen

    panels = []
    new_um = set(new.source_positions_um[:, 2].tolist())
    for called, calibration, depths, at_most in (
        ("measured", measured, used_um, 2),
        ("refocused", new, new_um, 3),
    ):
        depths_um = sorted(depths)
        for z_um in depths_um[:: max(1, -(-len(depths_um) // at_most))]:
            members = (calibration.source_positions_um[:, 2] == z_um).nonzero()[0]
            psf = calibration.psfs[members[calibration.part(members).nearest_to_axis()]].mean(axis=0)
            panels.append(Panel(called, as_seen(psf) / 255, depth_in_words(z_um), white=1.0))
    simulated = bool(new.provenance.get("simulated"))
    return pictures_figure("PSFs brought to another depth", panels, simulated=simulated)
