"""Optics side by side on one scene: ``optics``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from instrument.files.atomic import require_new
from instrument.files.errors import BenchError
from instrument.tasks.task import Desk, Done, task
from recon.base.declare import option
from recon.evaluation.optics_compared import Compared, OpticsOptions


@dataclass(frozen=True, kw_only=True)
class OpticsFiles:
    """Where the comparison goes."""

    out: Path = option(
        Path("optics.png"),
        help="The page (.png, .pdf, .svg); a table (.csv) beside.",
        flags=("--out", "-o"),
        label="Result",
    )
    force: bool = option(False, help="Overwrite files that exist.", label="Overwrite")


@task(
    "diffuserbench optics",
    "diffuserbench optics --photons 3e4 --photons 1e6 --out optics.pdf",
)
def optics(desk: Desk, files: OpticsFiles, options: OpticsOptions) -> Done:
    """Compare objective, smooth diffuser, regular and random lenslets on one scene at equal light.

    All have one aperture, distance and sensor (Kuo 2020, Figs. 6.2, 6.3). A picture in the focus of the
    lenses is photographed with few and many photons, beads in three depths once; light is propagated, and all
    is reconstructed alike, with the best of three weights. One minute.
    """
    from instrument.evaluation.optics_figure import BEADS, optics_figure
    from instrument.files.atomic import write_text
    from instrument.files.figures import check_figure, save_figure
    from recon.evaluation.optics_compared import compare_optics

    table = files.out.with_suffix(".csv")
    check_figure(files.out)
    for file in (files.out, table):
        require_new(file, overwrite=files.force)
    if len(set(options.photons)) < len(options.photons):
        raise BenchError("--photons: a number of photons is asked for twice.")
    with desk.step("Optics") as advance:
        compared = compare_optics(options, advance)
    lights = sorted(options.photons)
    found = compared.found.values()
    rows = [
        *([f"{light:,.0f}", *(f"{one.psnr_db[light]:.1f} dB" for one in found)] for light in lights),
        ["beads", *(f"{one.volume_psnr_db:.1f} dB" for one in found)],
        ["in place", *(f"{one.light_in_place:.0%}" for one in found)],
    ]
    desk.say("SIMULATED: light is propagated through modelled optics")
    desk.table(["photons", *compared.found], rows)
    desk.say(
        f"Beads: {options.beads} in three depths by {options.volume_photons:,.0f} photons. In place: "
        "their light a pixel at most from a bead, in its plane."
    )
    desk.say(BEADS)
    with desk.step("drawing"):
        save_figure(optics_figure(compared), files.out)
    write_text(table, optics_csv(compared.found))
    return Done((files.out, table))


def optics_csv(found: Mapping[str, Compared]) -> str:
    """Return the comparison as CSV, an optics a line: plain numbers, their units in the columns' names."""
    lights = sorted(next(iter(found.values())).psnr_db)
    names = ["optics", *(f"psnr_db_{light:g}_photons" for light in lights), "beads_psnr_db", "light_in_place"]
    rows = []
    for name, one in found.items():
        values = [*(one.psnr_db[light] for light in lights), one.volume_psnr_db, one.light_in_place]
        rows.append([name, *(f"{value:.7g}" for value in values)])
    return "".join(",".join(row) + "\n" for row in [names, *rows])
