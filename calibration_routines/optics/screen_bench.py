"""Calibrate with a screen instead of a pinhole: show random pictures, photograph them, solve for the PSF.

First bars tell which part of the screen the camera sees, then small bright squares where on the sensor each
place of it belongs (a projective map, from how far their patterns are displaced). Everything after that is
one run: black, levels of grey, which give the screen's light for each level, random pictures, and grey again,
which tells whether the light drifted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calibration_routines.display.display_io import require_slm
from calibration_routines.optics.screen_pairs import PairFiles, look_at_pairs, solve_pairs
from calibration_routines.optics.screen_pictures import Levels, ScreenMap, dead_leaves, random_cells
from calibration_routines.optics.screen_search import (
    FINDING,
    SEARCH,
    ScreenView,
    find_screen,
    search_not_kept,
)
from calibration_routines.optics.screen_solve import (
    AGAIN,
    JUDGED,
    PICTURE,
    SCREEN,
    SOLVING,
    TONE,
    TONES,
    ScreenOptions,
    ScreenRecord,
    finish_screen,
    solving_work,
)
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.analysis import channels_first
from calibration_routines.psf.sweep_plan import DARK
from calibration_routines.purpose import completed
from calibration_routines.routine import FromFiles, Routine
from instrument.bench.bench import Bench
from instrument.files.errors import BenchError
from instrument.plan import Part, Plan, estimate
from instrument.plan.model import Loop
from instrument.reconstruction.mosaic import in_colours
from instrument.runs.acquire import abilities_of
from instrument.runs.run_control import RunControl

_MOST_CELLS = 256  # rows of a picture
_EXPOSING = 12  # photographs until the exposure of the search is found, twice
_FIRST_LIGHT, _LIGHT, _FRAME = 700.0, 365.0, 11.0
"""Transforms of 1024 x 1024 a megapixel that a simulated bench takes for a screen: before its first picture,
for each one, for each frame of it."""
SHOWING = "showing pictures"
_ORDER: tuple[Loop, ...] = ("position", "slm", "light", "exposure", "repeat")


def screen_plan(
    shown: dict[str, Sequence[Path]], asked: ScreenOptions, exposure_ms: float | None = None
) -> Plan:
    """Return the plan of pictures, by what their frames are called."""
    exposures = () if exposure_ms is None else (exposure_ms,)
    return Plan(
        label="screen",
        parts=tuple(
            Part(
                label=label,
                slm_images=tuple(files),
                exposures_ms=exposures,
                repeats=asked.dark_frames if label == DARK else asked.average,
                order=_ORDER,
            )
            for label, files in shown.items()
        ),
    )


def draw_pictures(
    asked: ScreenOptions, found: ScreenMap, sensor: tuple[int, int], screen: tuple[int, int]
) -> dict[str, list[Levels]]:
    """Return the levels to show, by what their frames are called."""
    height, width = (asked.area * n for n in sensor)
    cell = max(1.0, 2 * found.scale(sensor), height / _MOST_CELLS)
    cells = max(8, int(height / cell)), max(8, int(width / cell))
    corner = tuple((n - 1 - count * cell) / 2 for n, count in zip(sensor, cells, strict=True))

    def drawn(picture: Levels) -> Levels:
        return found.drawn(picture, (corner[0], corner[1]), cell, screen)

    seeds = np.random.SeedSequence(asked.seed).generate_state(asked.pictures + asked.judged).tolist()
    tones = [drawn(np.full(cells, level, np.uint8)) for level in TONES]
    levels = {
        DARK: [np.zeros(screen, np.uint8)],
        TONE: tones,
        PICTURE: [drawn(random_cells(cells, seed)) for seed in seeds[: asked.pictures]],
        JUDGED: [drawn(dead_leaves(cells, seed)) for seed in seeds[asked.pictures :]],
        AGAIN: tones[-1:],
    }
    return {label: pictures for label, pictures in levels.items() if pictures}


def _unmade(count: int) -> list[Path]:
    """Return files of so many pictures, for a plan that is only estimated."""
    return [Path(f"{number}.png") for number in range(count)]


def screen_work(
    bench: Bench, asked: ScreenOptions, frames: int, pictures: int
) -> tuple[tuple[str, float], ...]:
    """Return what the steps compute, in transforms of 1024 x 1024 (:class:`Outlook`).

    A simulated bench computes what each picture lights, too, and what all of them need before the first.
    """
    camera = bench.camera
    seen = in_colours(np.zeros(camera.frame_shape, np.float32), camera.pixel_format)
    solving = solving_work(asked, channels_first(seen).shape)
    finding, showing = 0.0, 0.0
    if bench.simulated_kinds:
        megapixels = 1e-6 * seen.shape[0] * seen.shape[1]
        finding = megapixels * (_FIRST_LIGHT + _LIGHT * (SEARCH + _EXPOSING))
        showing = megapixels * (_LIGHT * (pictures + _EXPOSING / 2) + _FRAME * frames)
    return (FINDING, finding), (SHOWING, showing), (SOLVING, sum(solving))


def _written(levels: dict[str, list[Levels]], folder: Path) -> dict[str, Sequence[Path]]:
    import cv2

    files: dict[str, Sequence[Path]] = {}
    for label, pictures in levels.items():
        files[label] = [folder / f"{label}-{number}.png" for number in range(len(pictures))]
        for file, picture in zip(files[label], pictures, strict=True):
            cv2.imwrite(str(file), picture)
    return files


# Procedure ------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class ScreenProcedure(Procedure):
    """Find the screen, show pictures on it, and solve for the PSF."""

    asked: ScreenOptions

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse a bench without a screen; say what will be shown."""
        screen, asked = require_slm(bench), self.asked
        height, width = screen.shape
        if screen.identity.simulated and screen.identity.model != "screen":
            raise BenchError(f"The SLM of {bench.label} is no screen: it does not glow.")
        shown = {DARK: 1, TONE: len(TONES), PICTURE: asked.pictures, JUDGED: asked.judged, AGAIN: 1}
        plan = screen_plan({label: _unmade(count) for label, count in shown.items() if count}, asked)
        search = Plan(
            label=FINDING, parts=(Part(label=FINDING, slm_images=tuple(_unmade(SEARCH + _EXPOSING))),)
        )
        abilities = abilities_of(bench, folder or bench.config.data_folder)
        cost = estimate(plan, abilities)
        return Outlook(
            (
                f"A screen of {height} x {width} pixels; {SEARCH} photographs to find it, then "
                f"{asked.pictures} random pictures, {asked.judged} to judge by and {len(TONES)} grey levels: "
                f"{cost.frames} frames are kept.",
                "Nothing else may shine: darken the room, and let the screen warm up.",
            ),
            cost=cost,
            free_bytes=abilities.free_bytes,
            beside_s=estimate(search, abilities).waited_s,
            work=screen_work(bench, asked, cost.frames, sum(shown.values())),
        )

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Find the screen, take the run, and save the calibration in its folder."""
        asked = self.asked
        if bench.can_switch_source:
            bench.source_off()
        if bench.can_switch_scene:
            bench.scene_off()
        with search_not_kept():
            found = find_screen(bench, control, listener)
            height, width = bench.camera.frame_shape[:2]
            levels = draw_pictures(asked, found, (height, width), require_slm(bench).shape)
            listener.step(SHOWING)
            exposure_ms = ScreenView(bench, control).expose(levels[AGAIN][0], 0.7)
        record = ScreenRecord(asked, found, bench.geometry, bench.label, bool(bench.simulated_kinds))
        with TemporaryDirectory() as drawn:
            plan = screen_plan(_written(levels, Path(drawn)), asked, exposure_ms)
            run = SCREEN.prepare(bench, plan, folder, record, control, listener).execute()
        return finish_screen(completed(run), bench, control, listener)


ROUTINES = (
    Routine(
        name="screen",
        title="Screen instead of a pinhole",
        help="Measure the PSF by random pictures on a screen before the camera: no pinhole, no stage.",
        details="[slm] is the screen (second_display). Bars and bright squares tell where the camera sees it,"
        " grey levels its tone; then random pictures are photographed and solved for the PSF. The run can be "
        "resumed and has the calibration in its folder. With --pairs from photographs taken elsewhere.",
        options=ScreenOptions,
        procedure=ScreenProcedure,
        needs=("slm",),
        tried_on="screen",
        purpose=SCREEN,
        finish=finish_screen,
        files=FromFiles(
            options=PairFiles,
            named="pairs",
            uses=("judged", "z_um", "channels"),
            look=lambda _asked, files: look_at_pairs(files),
            make=solve_pairs,
            folder="calibration-screen",
        ),
        examples=(
            "diffuserbench new screen.toml --screen",
            "diffuserbench calibrate screen --bench screen.toml",
            "diffuserbench calibrate screen --bench screen.toml --pictures 30 --z 300",
            "diffuserbench calibrate screen --pairs photographs --out calibration",
        ),
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
