"""What is done on a bench and what comes next: from devices to a picture, a hologram or a surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.frame import Frame
from gui.session import BenchSession
from gui.session_news import OwnFiles, names_of
from instrument.bench.config import BenchConfig
from instrument.bench.lit import LightState, spoilt
from instrument.bench.lit import light_of as lit_now
from instrument.bench.photograph_file import PHOTOGRAPHS
from instrument.files.atomic import DOUBTFUL
from instrument.files.calibration_file import newest_calibration
from instrument.files.results import find_results
from instrument.live.light_log import light_words

_DARK = 0.05
"""Below this share of full scale a picture's brightest pixels are lost in the noise of most cameras."""
EXPOSE = "expose"
"""What the live view is asked to do: to find an exposure for what is lit."""
EXPOSING = "Auto exposure"
"""The job that does it, and the button that asks for it."""
AGAIN = "again"
"""What the live view is asked to do: to start."""
_STRIDE = 4
"""Of the pixels that are looked at, along both sides: the state of the light shows in a sixteenth."""


@dataclass(frozen=True, slots=True)
class Made:
    """What lies in a bench's folder: the newest of each, None where there is none.

    ``stale``: the photograph is newer than the result.
    """

    calibration: Path | None = None
    photograph: Path | None = None
    result: Path | None = None
    alignment: Path | None = None
    hologram: Path | None = None
    surface: Path | None = None
    stale: bool = False


@dataclass(frozen=True, slots=True)
class Facts:
    """What the next step depends on.

    Attributes
    ----------
    failed : tuple of str
        Kinds of devices that cannot be used.
    opening : bool
        Whether devices are still being opened.
    light : str
        Of the newest frame: ``"unknown"`` (none yet), ``"held"`` (none comes), ``"dark"``, ``"saturated"`` or
        ``"good"``.
    stuck : str
        Why the live view does not start; empty: it does.
    shown : bool
        Whether a pattern is on the SLM.
    made : Made
    """

    failed: tuple[str, ...] = ()
    opening: bool = False
    light: str = "unknown"
    stuck: str = ""
    shown: bool = False
    made: Made = Made()


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the way, and where it is taken.

    Attributes
    ----------
    name : str
        One word, for the strip.
    done : bool
    words : str
        What is to be done, one sentence.
    answer : str
        On the button that leads there.
    panel : str
        Where it is taken, of the table of panels; ``"reconnect"``: nowhere, the devices in
        ``what`` are opened again.
    what : object
        What that panel is to work with; empty: nothing.
    """

    name: str
    done: bool
    words: str
    answer: str
    panel: str
    what: object = ""


def made_in(runs: Path) -> Made:
    """Return what lies in a folder of runs; reads it, so for a job."""
    results = find_results(runs)
    photograph = _newest(runs, f"{PHOTOGRAPHS}/*.tif", "*_photograph/photograph.tif")
    return Made(
        calibration=newest_calibration(runs),
        photograph=photograph,
        result=results[0] if results else None,
        alignment=_newest(runs, "*align*.json", "*/*align*.json"),
        hologram=_newest(runs, "holograms/*.png"),
        surface=_newest(runs, "*/dpc.json"),
        stale=photograph is not None and bool(results) and _is_newer(photograph, results[0]),
    )


def _newest(folder: Path, *patterns: str) -> Path | None:
    files = [file for pattern in patterns for file in folder.glob(pattern)]
    wanted = [file for file in files if not file.name.startswith((DOUBTFUL, "."))]  # a draft begins with one
    found = [(file.stat().st_mtime, file) for file in wanted]
    return max(found)[1] if found else None


def light_of(frame: Frame | None, lit: LightState = LightState.AS_IS) -> str:
    """Return how bright a frame in a light is: ``"unknown"``, ``"dark"``, ``"saturated"`` or ``"good"``."""
    if frame is None:
        return "unknown"
    metadata = frame.metadata
    if spoilt(metadata.saturated_fraction, frame.image.size, lit):
        return "saturated"
    brightest = int(frame.image[::_STRIDE, ::_STRIDE].max())
    return "dark" if brightest < _DARK * ((1 << metadata.significant_bits) - 1) else "good"


def _light_now(session: BenchSession) -> str:
    newest = session.live.newest()
    if newest is None and not session.live.is_running and not session.viewing.wanted:
        return "held"
    then = "" if newest is None else session.lights.during(newest.metadata)
    if then and then != light_words(session.bench) and session.live.is_running:
        return "awaited"  # of the light before: on a large simulated sensor for seconds
    return light_of(newest, lit_now(session.bench))


def facts_of(session: BenchSession, made: Made) -> Facts:
    """Return how a session stands now; reads no file and asks no device."""
    states = {kind: session.state(kind).condition for kind in session.kinds}
    slm = session.bench.slm
    return Facts(
        failed=tuple(kind for kind, state in states.items() if state == "failed"),
        opening="opening" in states.values() or (bool(states) and set(states.values()) == {"closed"}),
        light=_light_now(session),
        stuck=session.viewing.failure,
        shown=slm is not None and session.is_open("slm") and bool(slm.displayed.any()),
        made=made,
    )


def steps_of(config: BenchConfig, facts: Facts) -> tuple[Step, ...]:
    """Return the way on this bench, each step done or not."""
    steps = _WAYS[_way_of(config)](facts)
    if not config.devices:
        return steps
    failed = facts.failed
    if facts.stuck and not failed:
        words = f"The live view does not start, and is tried again by itself: {facts.stuck.splitlines()[0]}"
        return (Step("Connect", False, words, "Try again now", "live", AGAIN), *steps)
    whose = "its chip says" if len(failed) == 1 else "their chips say"
    words = f"The {names_of(failed)} failed; {whose} why." if failed else "The devices are being opened."
    answer = "Reconnect all" if len(failed) > 1 else "Reconnect"
    connect = Step("Connect", not failed and not facts.opening, words, answer, "reconnect", failed)
    return (connect, *steps)


def next_of(steps: Sequence[Step]) -> Step | None:
    """Return the step that comes next; None where all are done."""
    return next((step for step in steps if not step.done), None)


def _way_of(config: BenchConfig) -> str:
    kinds = set(config.devices)
    if not kinds:
        return "files"
    if "slm" in kinds and config.devices["slm"].driver_name.endswith("screen"):
        return "screen"
    # The LED array of a display is lasers for pictures in colour: no point source is said, no diffuser.
    camera = config.source.model_fields_set or config.geometry.model_fields_set
    lasers = bool(config.display.model_fields_set) and not camera
    if "slm" in kinds and ("led_array" not in kinds or lasers):
        return "display"
    return "microscope" if "led_array" in kinds and not kinds & {"stage", "slm"} else "camera"


def _photographed(facts: Facts, routine: str, calibrate: str) -> tuple[Step, ...]:
    """Return the way from the light to a reconstruction."""
    made = facts.made
    stale = made.result is None or made.stale
    photograph = "" if made.photograph is None else made.photograph.name
    return (
        _exposed(facts, later=made.calibration is not None or made.photograph is not None),
        Step("Calibrate", made.calibration is not None, calibrate, "Calibrate…", "sweeps", routine),
        Step(
            "Photograph",
            made.photograph is not None,
            "Calibrated. Photograph the scene: exposure and dark frames are looked after.",
            "Photograph…",
            "sweeps",
            "photograph",
        ),
        Step(
            "Reconstruct",
            made.photograph is not None and not stale,
            f"{photograph} is not reconstructed yet.",
            "Reconstruct…",
            "reconstructions",
            made.photograph or "",
        ),
    )


def _exposed(facts: Facts, *, later: bool) -> Step:
    """Return the step to a picture that can be used; ``later``: what came after it is done."""
    words = {
        "unknown": "The first frame is awaited.",
        "awaited": "The light was changed: a frame in the new one is awaited.",
        "held": "The live view is held: let it go on by “Live”.",
        "dark": "The picture is nearly black: light the scene, or expose longer.",
        "saturated": "The picture is saturated: expose shorter.",
    }.get(facts.light, "")
    what = "" if facts.light in ("unknown", "awaited", "held") else EXPOSE
    answer = EXPOSING if what else "Look at it"
    return Step("Expose", later or facts.light == "good", words, answer, "live", what)


def _camera(facts: Facts) -> tuple[Step, ...]:
    words = "No calibration yet: measure what a point of light gives at each depth (its PSFs)."
    return _photographed(facts, "axial", words)


def _screen(facts: Facts) -> tuple[Step, ...]:
    words = "No calibration yet: find the PSF by pictures on the screen."
    return _photographed(facts, "screen", words)


def _display(facts: Facts) -> tuple[Step, ...]:
    made = facts.made
    aligned, computed = made.alignment is not None, made.hologram is not None
    words = "The scattering mask is not aligned yet: find where it is."
    return (
        Step("Align", aligned, words, "Align…", "alignment"),
        Step(
            "Compute",
            computed,
            "Aligned. Choose a picture and compute its hologram.",
            "Compute…",
            "holograms",
        ),
        Step(
            "Show", computed and facts.shown, "Nothing is on the SLM: show the pattern.", "Show…", "holograms"
        ),
    )


def _microscope(facts: Facts) -> tuple[Step, ...]:
    measured = facts.made.surface is not None
    words = "No surface yet: four photographs under half circles of light give its phase."
    return (
        _exposed(facts, later=measured),
        Step("Measure", measured, words, "Measure…", "sweeps", "dpc"),
    )


def _files(facts: Facts) -> tuple[Step, ...]:
    words = "No bench is open: try a simulated one, open yours, or reconstruct files."
    return (
        Step("Choose", facts.made.result is not None, words, "Start page", "start"),
        Step("Reconstruct", facts.made.result is not None, "", "", "reconstructions"),
    )


def after_all(config: BenchConfig, facts: Facts) -> Step:
    """Return what may be done where all is done: look at the result, or begin again."""
    steps = steps_of(config, facts)
    result, way = facts.made.result, _way_of(config)
    if way == "display":
        return replace(steps[-2], words="The pattern is on the SLM: photograph it, or compute another.")
    if result is None:
        return replace(steps[-1], words=f"All is done: {steps[-1].name.lower()} again, or go on.")
    words = f"All is done; the newest result is {result.stem}."
    return Step("", True, words, "Look at it", "reconstructions", OwnFiles(result=result))


def _is_newer(file: Path, than: Path) -> bool:
    try:
        return file.stat().st_mtime > than.stat().st_mtime
    except OSError:  # gone meanwhile
        return False


_WAYS: dict[str, Callable[[Facts], tuple[Step, ...]]] = {
    "camera": _camera,
    "screen": _screen,
    "display": _display,
    "microscope": _microscope,
    "files": _files,
}
