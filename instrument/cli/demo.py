"""``diffuserbench demo``: the main job, start to end, on the simulated bench."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calibration_routines.demos.camera import run_demo
from calibration_routines.demos.display import DisplayDemoSettings, run_display_demo
from calibration_routines.demos.film import FilmSettings, run_film
from calibration_routines.demos.result import DemoResult
from calibration_routines.demos.settings import DemoSettings
from instrument.cli.app import App, examples
from instrument.cli.calibrate import TerminalListener

app = App(
    "Try the whole way on the simulated bench; without a name: demo camera.",
    usual="camera",
)
OutFolder = Annotated[
    Path, typer.Option("--out", "-o", metavar="FOLDER", help="Where the demo's folder is made.")
]


@app.command("camera", epilog=examples("diffuserbench demo", "diffuserbench demo --out /tmp/demos"))
def demo(options: DemoSettings, out: OutFolder = Path("runs")) -> None:
    """Calibrate a SIMULATED lensless camera, photograph scenes with it, reconstruct and judge what comes out.

    Homes the stage, places the point source, exposes without saturating, takes dark frames, sweeps the source
    along the axis, checks the PSFs; photographs a picture on a screen in three colours and lights in a
    volume, reconstructs both, compares them with the ground truth, charts what methods cost against how good
    they are, and writes everything into one folder. Motion and exposures are fifty times as fast as on a real
    bench. Ctrl-C stops it at any moment, the bench safe.
    """
    with _Terminal(Console(highlight=False)) as listener:
        result = run_demo(out, listener, options)
    listener.verdict(result)


@app.command("film", epilog=examples("diffuserbench demo film", "diffuserbench demo film --frames 100"))
def film(settings: FilmSettings, out: OutFolder = Path("runs")) -> None:
    """Film a SIMULATED animal that moves and flashes, reconstruct the film, find what is active, judge it.

    Calibrates the simulated microscope with nine PSFs, records, reconstructs with the camera model that the
    film asks for, looks for activity, and draws cells, dF/F and blood flow beside the truth. Takes minutes.
    """
    with _Terminal(Console(highlight=False)) as listener:
        result = run_film(out, listener, settings)
    listener.ended(result.seconds, result.files)
    for line in result.lines():
        typer.echo(line)


@app.command("display", epilog=examples("diffuserbench demo display"))
def display(settings: DisplayDemoSettings, out: OutFolder = Path("runs")) -> None:
    """Align the mask of a SIMULATED holographic display, learn how it differs, show and photograph a picture.

    The picture is computed twice, by the alignment alone and by what was learned of the display; both are
    photographed and compared with what was wanted. Then it is shown in three colours, one after the other.
    Takes minutes.
    """
    with _Terminal(Console(highlight=False)) as listener:
        result = run_display_demo(out, listener, settings)
    listener.ended(result.seconds, result.files)
    for line in result.lines():
        typer.echo(line)


class _Terminal(TerminalListener):
    """Shows on the terminal what the demo does, and prints what it says on the way."""

    def said(self, words: str) -> None:
        """Print it."""
        self.print([words])

    def ended(self, stages: Mapping[str, float], files: Mapping[str, Path]) -> None:
        """Print how long each stage took, and what there is now."""
        self._console.print("\nSeconds")
        for name, seconds in stages.items():
            self._console.print(f"  {seconds:6.1f}  {name}")
        self._console.print(f"  {sum(stages.values()):6.1f}  in all")
        self._console.print("\nFiles (SIMULATED data)")
        for name, path in files.items():
            self._say(f"  {name:<30} {path}")

    def verdict(self, result: DemoResult) -> None:
        """Print times, files, and how good picture and volume are."""
        self.ended(result.seconds, result.files)
        comparison, placed = result.comparison, result.placed
        self._console.print()
        for name, solved in (("Picture", result.reconstruction), ("Volume", result.volume)):
            self._say(
                f"{name}: {solved.solver} with {solved.prior}, {len(solved.history)} iterations in "
                f"{solved.seconds:.1f} s; stopped because {solved.stop_reason}."
            )
            for warning in solved.warnings:
                self._say(f"Note: {warning}")
        self._say(
            f"Lights: {placed.in_plane} of {len(placed.planes)} found within half a plane of their depth."
        )
        self._say(
            f"PSNR {comparison.psnr_db:.2f} dB, SSIM {comparison.ssim:.3f} against the ground truth: inside "
            "the screen, in linear light, after one least-squares scale factor, brightness over the field "
            "corrected by the measured response."
        )

    def _say(self, text: str) -> None:
        self._console.print(escape(text), soft_wrap=True)
