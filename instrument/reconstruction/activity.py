"""Activity of a reconstructed video, from file to files: traces, regions, dF/F, pictures and a film."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.atomic import whole_file, write_json, write_text
from instrument.files.errors import BenchError, FileError
from instrument.files.films import write_mp4
from instrument.files.record import plain
from instrument.reconstruction.video_files import DEFAULT_FPS, VideoPictures, create_output, levels_of
from recon.arrays import Float32Array, Float64Array
from recon.base.declare import option
from recon.streams.activity import LEAST_FRAMES, baseline, change, fading, floor_of, smoothed
from recon.streams.motion import Motion, aligned, motion
from recon.streams.regions import Region, Search, find_regions, local_correlation, noise_of

WINDOW_S = 30.0
"""Of the sliding baseline, where the video's times are known; as many frames as at 10 a second otherwise."""

COPIES = 8
"""Arrays of the video's size that the work holds at once: 7.1 measured."""

RED_PERCENTILE = 99.9
"""Of dF/F that is shown fully red."""

TRACES_SHOWN = 20
"""Traces drawn; more would not be told apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActivitySettings:
    """How activity is looked for."""

    window_s: float = option(
        WINDOW_S, help="Of the sliding baseline.", unit="s", least=0, flags=("--window",), group="Activity"
    )
    percentile: float = option(
        20.0, help="Of a window that is the baseline.", least=0, most=100, group="Activity"
    )
    align: bool = option(False, help="Move frames back to one place first.", group="Activity")
    least_correlation: float = option(
        0.5,
        help="Local correlation from which a region begins.",
        least=0,
        most=1,
        flags=("--correlation",),
        group="Activity",
    )
    radius_px: float = option(
        8.0,
        help="As far as a region reaches.",
        unit="px",
        least=1,
        flags=("--radius",),
        group="Activity",
    )
    smooth_px: float = option(
        0.0,
        help="Gaussian by which frames are smoothed to look for regions: a small cell's width.",
        unit="px",
        least=0,
        flags=("--smooth",),
        default_words="not at all",
        group="Activity",
    )
    """As :func:`recon.streams.activity.find_regions`."""


@dataclass(frozen=True, slots=True)
class Activity:
    """What was found in a video."""

    indices: tuple[int, ...]
    """The video's frames that there are; all arrays below hold these."""
    times_s: Float64Array
    """float64, (n_frames,): frame numbers, where the video's times are not known."""
    frames: Float32Array
    dff: Float32Array
    """float32, (n_frames, height, width): fluorescence, and its relative change."""
    search: Search
    """Regions, what was left out, and the local correlation, float32, (height, width)."""
    traces: Float32Array
    """float32, (n_regions, n_frames): dF/F of the regions' mean fluorescence."""
    motion: Motion
    """Before alignment."""
    faded: float
    """Share of the field's light that is lost by the end; negative where it grows."""
    still_moving_px: float = 0.0
    """How far frames move that were moved back, where they do not stand still: no region is looked for."""

    @property
    def regions(self) -> list[Region]:
        """Places that are active."""
        return self.search.regions


def require_frames(path: Path, count: int) -> None:
    """Raise FileError where a film is too short for its activity to be told from noise."""
    if count < LEAST_FRAMES:
        raise FileError(
            path,
            f"has {count} pictures; activity is looked for in {LEAST_FRAMES} at least.",
            "In fewer nothing tells it from noise: record for longer.",
        )


def find_activity(
    video: VideoPictures, settings: ActivitySettings | None = None, *, free_bytes: int | None = None
) -> Activity:
    """Look for activity in a reconstructed video.

    ``video``: colour is averaged, the light of all depths added up. ``free_bytes``: memory that may be
    taken; refused where the video needs more.

    Raises BenchError, FileError or InputError when the video is too short, too large, or dark.
    """
    settings = settings or ActivitySettings()
    indices = [index for index in range(len(video)) if video.is_written(index)]
    require_frames(video.path, len(indices))
    height, width = video.flat(indices[0]).shape[:2]
    need = COPIES * len(indices) * height * width * 4
    if free_bytes is not None and need > free_bytes:
        raise BenchError(
            f"{video.path}: {len(indices)} pictures of {height} x {width} need {need / 2**30:.1f} GiB of "
            f"memory, {free_bytes / 2**30:.1f} are free. Reconstruct with --bin 2, or a --crop."
        )
    frames = np.empty((len(indices), height, width), np.float32)
    for place, index in enumerate(indices):
        picture = video.flat(index)
        frames[place] = picture.mean(axis=2) if picture.ndim == 3 else picture
    found = motion(frames)
    still_moving_px = 0.0
    if settings.align:
        frames = aligned(frames, found)
        left = motion(frames)
        still_moving_px = 0.0 if left.is_still else left.largest_px
    period_s = video.period_s
    window = round(settings.window_s / (period_s or 0.1))
    fade = fading(frames)
    base = baseline(frames, max(window, 3), settings.percentile, fade)
    floor = floor_of(frames)
    dff = change(frames, base, floor)
    looked_at = frames
    if settings.smooth_px:
        looked_at = smoothed(frames, settings.smooth_px)
        base = baseline(looked_at, max(window, 3), settings.percentile, fade)
    noise = noise_of(looked_at)
    excess = np.subtract(looked_at, base, out=base)
    del looked_at
    if still_moving_px:
        search = Search([], {}, local_correlation(excess))
    else:
        search = find_regions(
            excess,
            least_correlation=settings.least_correlation,
            radius_px=settings.radius_px,
            noise=noise,
            moved=None if found.is_still else found,
            field=video.calibrated_px,
        )
    traces = np.zeros((len(search.regions), len(indices)), np.float32)
    for trace, region in zip(traces, search.regions, strict=True):
        light = region.trace(frames)[:, None, None]
        level = baseline(light, max(window, 3), settings.percentile, fade)
        trace[...] = change(light, level, floor)[:, 0, 0]
    return Activity(
        indices=tuple(indices),
        times_s=np.array(indices) * (period_s or 1.0),
        frames=frames,
        dff=dff,
        search=search,
        traces=traces,
        motion=found,
        faded=1 - float(fade[-1]),
        still_moving_px=still_moving_px,
    )


def write_activity(
    activity: Activity, video: VideoPictures, folder: Path, settings: ActivitySettings
) -> list[Path]:
    """Write what was found into a folder, which is made; returns the files.

    ``traces.csv``, ``regions.csv``, ``activity.png``, ``dff.ome.zarr``, ``activity.mp4``, ``activity.json``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made = [folder / name for name in ("traces.csv", "regions.csv", "activity.png", "dff.ome.zarr")]
    write_text(made[0], _traces_csv(activity, video))
    write_text(made[1], _regions_csv(activity))
    origin = video.attributes.get("diffuserbench", {})
    simulated = bool(origin.get("simulated"))
    with whole_file(made[2]) as temporary:
        write_activity_figure(temporary, activity, simulated=simulated)
    create_output(
        made[3],
        len(video),
        activity.dff.shape[1:],
        period_s=video.period_s,
        grid=None if "z" in video.axes else video.grid,  # planes seen as one differ in their pitch
        attributes={"quantity": "dF/F", "of": str(video.path.resolve()), "simulated": simulated},
    )
    stack = VideoPictures(made[3], write=True)
    for index, picture in zip(activity.indices, activity.dff, strict=True):
        stack.write(index, picture)
    film = folder / "activity.mp4"
    write_mp4(film, red_over_grey(activity), 1 / video.period_s if video.period_s else DEFAULT_FPS)
    record = folder / "activity.json"
    found = {
        "video": str(video.path.resolve()),
        "settings": asdict(settings),
        "simulated": simulated,
        "frames": len(activity.indices),
        "regions": len(activity.regions),
        "left_out": activity.search.left_out,
        "largest_motion_px": activity.motion.largest_px,
        "faded": activity.faded,
        "software": origin.get("software"),
    }
    write_json(record, plain(found))
    return [*made, film, record]


def write_activity_figure(path: Path, activity: Activity, *, simulated: bool) -> None:
    """Draw mean fluorescence with the regions, local correlation, traces, and motion; PNG."""
    from matplotlib.figure import Figure  # costs half a second; only who draws pays

    figure = Figure(figsize=(12, 7.5), layout="constrained")
    mark = "   SIMULATED" if simulated else ""
    figure.suptitle(
        f"{len(activity.regions)} regions in {len(activity.indices)} frames; frames off their place by up to "
        f"{activity.motion.largest_px:.2f} pixels{mark}"
    )
    grid = figure.add_gridspec(3, 2, height_ratios=(3, 2.4, 0.8))
    mean = activity.frames.mean(axis=0)
    for place, (image, title, colours) in enumerate(
        (
            (mean, "mean fluorescence, regions", "gray"),
            (activity.search.correlation, "local correlation", "magma"),
        )
    ):
        axes = figure.add_subplot(grid[0, place])
        shown = axes.imshow(image, cmap=colours, vmax=float(np.percentile(image, 99.8)))
        figure.colorbar(shown, ax=axes)
        axes.set_title(title)
        axes.set_axis_off()
        for number, region in enumerate(activity.regions):
            row, column = region.centre
            radius = max(float(np.sqrt(len(region.rows) / np.pi)), 2.0) + 1
            colour = f"C{number % 10}"
            turn = np.linspace(0, 2 * np.pi, 40)
            axes.plot(column + radius * np.cos(turn), row + radius * np.sin(turn), color=colour, lw=1)
            axes.annotate(str(number), (column + radius, row - radius), color=colour, fontsize=7)
    axes = figure.add_subplot(grid[1, :])
    step = 1.1 * float(np.max(activity.traces, initial=0.1))
    for number, trace in enumerate(activity.traces[:TRACES_SHOWN]):
        axes.plot(activity.times_s, trace + number * step, color=f"C{number % 10}", lw=0.9)
    axes.set_ylabel(f"dF/F, {step:.2g} apart")
    axes.set_xlim(float(activity.times_s[0]), float(activity.times_s[-1]))
    below = figure.add_subplot(grid[2, :], sharex=axes)
    below.plot(activity.times_s, activity.motion.shifts, lw=0.9, label=["rows", "columns"])
    below.set_ylabel("off by (px)")
    below.set_xlabel("time (s), or frame number")
    below.legend(fontsize=7, loc="upper right")
    figure.savefig(path, dpi=110, format="png")


def red_over_grey(activity: Activity) -> Any:
    """Yield the film's pictures: fluorescence in grey, its relative increase in red (Kuo 2020, Fig. 6.5)."""
    black, white = levels_of(activity.frames[:: max(1, len(activity.frames) // 24)])
    full = float(np.percentile(activity.dff, RED_PERCENTILE)) or 1.0
    red = np.array([1.0, 0.1, 0.05])
    for frame, dff in zip(activity.frames, activity.dff, strict=True):
        grey = np.clip((frame - black) / (white - black), 0, 1)[..., None]
        share = np.clip(dff / full, 0, 1)[..., None]
        yield np.round(255 * ((1 - share) * grey + share * red)).astype(np.uint8)


def _traces_csv(activity: Activity, video: VideoPictures) -> str:
    time = "time_s" if video.period_s else "frame_number"
    header = ["frame", time, *(f"region_{n}_dff" for n in range(len(activity.regions)))]
    frames = zip(activity.indices, activity.times_s, activity.traces.T, strict=True)
    return _csv(header, ([i, f"{at:.12g}", *(f"{value:.5f}" for value in dff)] for i, at, dff in frames))


def _regions_csv(activity: Activity) -> str:
    header = ["region", "row", "column", "pixels", "local_correlation", "largest_dff"]
    rows = (
        [n, *(f"{at:.2f}" for at in region.centre), len(region.rows), f"{region.correlation:.3f}",
         f"{trace.max():.4f}"]
        for n, (region, trace) in enumerate(zip(activity.regions, activity.traces, strict=True))
    )  # fmt: skip
    return _csv(header, rows)


def _csv(header: list[str], rows: Iterable[list[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()
