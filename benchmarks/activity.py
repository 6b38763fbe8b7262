"""Neurons that fire and beads that flow: what a reconstructed video tells of them, and where it breaks.

    python benchmarks/activity.py [--frames 240] [--out FOLDER] [--nothing]

Light is cast lenslet by lenslet from points at continuous places (recon/evaluation/lenslets.py): no grid, no
convolution. Neurons: clouds of points with a resting light of 0.5 to 1.5 and calcium transients (dF/F up to
1, decay half a second at 10 frames/s), on tissue that shines as much as all of them together and does not
change; all bleach by a third, photon and read noise. The video is reconstructed with warm starts and
searched as ``diffuserbench activity`` does; a region is a neuron's when it lies within 3 pixels. Beads:
drift along a channel, fastest in its middle, bleach, and drift across it by two pixels in all; found as the
peaks of each picture and linked from frame to frame. ``--nothing``: scenes that stand or move, in which
nothing is active and no region may be found.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon.base.threads import set_threads
from recon.errors import InputError
from recon.evaluation.lenslets import LensletCamera, build_camera
from recon.streams.activity import baseline, change, fading, floor_of
from recon.streams.motion import aligned, motion
from recon.streams.regions import find_regions, noise_of
from recon.streams.video import BLOCK, VideoSolver, stream_problem

SHAPE = (128, 160)
READ_NOISE = 2.0
NEAR_PX = 3.0
DEFAULT = {
    "photons": 3000.0,
    "neurons": 20,
    "tissue": 1.0,
    "warm": 6,
    "motion_px": 0.0,
    "bleached": 0.33,
    "align": False,
}
SWEEPS = {
    "photons": (30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0),
    "neurons": (5, 10, 20, 40, 80),
    "tissue": (0.0, 1.0, 3.0, 10.0),
    "warm": (1, 2, 3, 4, 6, 12),
    "motion_px": (0.0, 0.5, 1.0, 3.0),
    "bleached": (0.0, 0.33, 0.7, 0.9, 0.97),
}

BEADS = ((10, 3000), (10, 300), (10, 100), (10, 30), (20, 3000), (40, 3000), (80, 3000))


def points(camera: LensletCamera, places, light) -> np.ndarray:
    """Return points that a picture shows at ``places``, (rows, columns) from its centre."""
    z = camera.focus_um
    scale = camera.pitch_um * z / camera.distance_um
    places = np.asarray(places, float).reshape(-1, 2)
    power = np.broadcast_to(light, len(places))
    return np.column_stack([-places[:, 1] * scale, -places[:, 0] * scale, np.full(len(places), z), power])


def expose(clean: np.ndarray, photons: float, rng: np.random.Generator) -> np.ndarray:
    """Return counts with ``photons`` where ``clean`` is 1."""
    return (rng.poisson(clean * photons) + rng.normal(0, READ_NOISE, clean.shape)).astype(np.float32)


def transients(count: int, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return dF/F of neurons at 10 frames a second, (count, frames)."""
    spikes = (rng.random((count, frames)) < 0.015) * rng.uniform(0.3, 1.0, (count, 1))
    for course in spikes:
        if not course.any():
            course[rng.integers(frames // 4, 3 * frames // 4)] = 0.7
    decay = np.exp(-np.arange(40) / 5)
    return np.array([np.convolve(course, decay)[:frames] for course in spikes])


def apart(count: int, rng: np.random.Generator, least_px: float) -> np.ndarray:
    """Return places at least so far from one another, in the middle of the field."""
    found: list[np.ndarray] = []
    tries = 0
    while len(found) < count:
        place = rng.uniform(-0.4, 0.4, 2) * SHAPE
        tries += 1
        if tries > 20000:
            least_px *= 0.8
            tries = 0
        if all(np.hypot(*(place - other)) > least_px for other in found):
            found.append(place)
    return np.array(found)


def solve(psf: np.ndarray, frames: list[np.ndarray], warm: int) -> np.ndarray:
    """Return the pictures of a video."""
    solver = VideoSolver(stream_problem(frames[0], psf), warm_iterations=warm)
    pictures = []
    for number, frame in enumerate(frames):
        if number % BLOCK == 0:
            solver.begin()
        pictures.append(solver.next(frame))
    return np.stack(pictures)


def neurons(  # noqa: PLR0913 - what its table varies
    frames: int,
    *,
    photons: float,
    neurons: int,
    tissue: float,
    warm: int,
    motion_px: float,
    bleached: float,
    align: bool = False,
    seed: int = 0,
):
    """Simulate, reconstruct, search; return figures, pictures, dF/F, regions, traces and truth."""
    rng = np.random.default_rng(seed)
    camera = build_camera(SHAPE, seed=1)
    psf = camera.light([[0, 0, camera.focus_um, 1.0]])
    places = apart(neurons, rng, 9.0)
    rest = rng.uniform(0.5, 1.5, neurons)
    clouds = [place + rng.normal(0, 1.0, (14, 2)) for place in places]
    cast = np.stack([camera.light(points(camera, c, b / 14)) for c, b in zip(clouds, rest, strict=True)])
    around = camera.light(
        points(camera, rng.uniform(-0.5, 0.5, (600, 2)) * SHAPE, tissue * rest.sum() / 600 if tissue else 0.0)
    )
    active = transients(neurons, frames, rng)
    way = motion_px * np.sin(2 * np.pi * np.arange(frames) / 60)
    bleach = (1 - bleached) ** (np.arange(frames) / frames)
    brightest = float((cast.sum(axis=0) + around).max())
    raw = []
    for t in range(frames):
        clean = (np.tensordot(1 + active[:, t], cast, axes=1) + around) * bleach[t] / brightest
        if way[t]:  # a moved sample moves its pattern
            clean = np.maximum(ndimage.shift(clean, (0, way[t]), order=3, mode="nearest"), 0)
        raw.append(expose(clean, photons, rng))
    pictures = solve(psf, raw, warm)
    found_motion = motion(pictures)
    if align:
        pictures = aligned(pictures, found_motion)
    fade = fading(pictures)
    base = baseline(pictures, 100, fade=fade)
    floor = floor_of(pictures)
    dff = change(pictures, base, floor)
    search = find_regions(
        pictures - base, noise=noise_of(pictures), moved=None if found_motion.is_still else found_motion
    )
    regions = search.regions
    centre = np.array(SHAPE) // 2
    traces = []
    for region in regions:
        light = region.trace(pictures)[:, None, None]
        level = baseline(light, 100, fade=fade)
        traces.append(change(light, level, floor)[:, 0, 0])
    distance = np.array([[np.hypot(*(np.array(r.centre) - centre - p)) for p in places] for r in regions])
    correlations = []
    if len(regions):
        for row, column in zip(*linear_sum_assignment(np.minimum(distance, 1e3)), strict=True):
            if distance[row, column] <= NEAR_PX:
                correlations.append(float(np.corrcoef(traces[row], active[column])[0, 1]))
    # All neurons' courses at their true places, whether found as a region or not.
    inside = [np.round(centre + p).astype(int) for p in places]
    at_place = []
    for (row, column), course in zip(inside, active, strict=True):
        light = pictures[:, row - 2 : row + 3, column - 2 : column + 3].mean(axis=(1, 2))[:, None, None]
        level = baseline(light, 100, fade=fade)
        trace = change(light, level, floor)[:, 0, 0]
        at_place.append(float(np.corrcoef(trace, course)[0, 1]) if trace.std() > 0 else 0.0)
    figures = {
        "found": len(correlations),
        "of": neurons,
        "false": len(regions) - len(correlations),
        "median_correlation": float(np.median(correlations)) if correlations else 0.0,
        "least_correlation": min(correlations, default=0.0),
        "median_at_true_places": float(np.median(at_place)),
        "motion_found_px": found_motion.largest_px,
    }
    return figures, pictures, dff, regions, traces, (places + centre, active)


def flow(frames: int, count: int, photons: float, warm: int = 6, seed: int = 0):
    """Simulate beads in a channel, reconstruct, find and link them; return figures, pictures and tracks."""
    rng = np.random.default_rng(seed)
    camera = build_camera(SHAPE, seed=1)
    psf = camera.light([[0, 0, camera.focus_um, 1.0]])
    half = 0.2 * SHAPE[0]
    rows, start = rng.uniform(-half, half, count), rng.uniform(-0.42, 0.42, count) * SHAPE[1]
    speed = 1.6 * (1 - (rows / (1.15 * half)) ** 2)
    light = rng.uniform(0.6, 1.4, count)
    field = 0.42 * SHAPE[1]
    truth, raw = [], []
    for t in range(frames):
        columns = (start + speed * t + field) % (2 * field) - field
        places = np.column_stack([rows + 2.0 * t / frames, columns])
        truth.append(places + np.array(SHAPE) // 2)
        clean = camera.light(points(camera, places, light * np.exp(-0.5 * t / frames)))
        if t == 0:
            brightest = float(clean.max())
        raw.append(expose(clean / brightest, photons, rng))
    pictures = solve(psf, raw, warm)
    found = [_peaks(picture) for picture in pictures]
    hits = misses = wrong = 0
    errors = []
    for seen, known in zip(found, truth, strict=True):
        cost = np.hypot(*(seen[:, None] - known[None]).T).T if len(seen) else np.zeros((0, len(known)))
        matched = zip(*linear_sum_assignment(np.minimum(cost, 50)), strict=True)
        pairs = [(r, c) for r, c in matched if cost[r, c] <= NEAR_PX]
        hits, misses = hits + len(pairs), misses + len(known) - len(pairs)
        wrong += len(seen) - len(pairs)
        errors += [float(cost[r, c]) for r, c in pairs]
    tracks = _linked(found)
    long = [track for track in tracks if len(track) >= 8]
    pure = [_purity(track, truth) for track in long]
    figures = {
        "beads": count,
        "photons": photons,
        "recall": hits / (hits + misses),
        "false_share": wrong / max(hits + wrong, 1),
        "error_px": float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan"),
        "tracks": len(long),
        "median_length": float(np.median([len(track) for track in long])) if long else 0.0,
        "pure_share": float(np.mean([p >= 0.95 for p in pure])) if pure else 0.0,
    }
    return figures, pictures, tracks


STILL_SHAPE = (64, 80)


def nothing(kind: str, frames: int, photons: float, speed: float, seed: int = 0) -> dict:
    """Simulate a scene in which nothing is active, reconstruct and search it; return figures.

    ``speed``: pixels a frame; of a swaying sheet its amplitude, of a period of 50 frames.
    """
    rng = np.random.default_rng(seed)
    camera = build_camera(STILL_SHAPE, seed=1)
    psf = camera.light([[0, 0, camera.focus_um, 1.0]])
    times = np.arange(frames)
    if kind == "static":
        cells = np.repeat(rng.uniform(-0.4, 0.4, (12, 2)) * STILL_SHAPE, 10, axis=0)
        places = np.concatenate(
            [cells + rng.normal(0, 1, cells.shape), rng.uniform(-0.5, 0.5, (400, 2)) * STILL_SHAPE]
        )
        light = np.repeat([0.1, 0.02], [len(cells), 400])
    elif "sheet" in kind and "edge" not in kind:
        places, light = rng.uniform(-1, 1, (2000, 2)) * STILL_SHAPE, rng.gamma(0.5, 1, 2000)
    elif kind == "edge of a sheet":
        y, x = np.mgrid[-40:40:1.5, -60:60:1.5]
        places = np.column_stack([y.ravel(), x.ravel()]) + rng.normal(0, 0.2, (y.size, 2))
        light = np.ones(len(places))
    else:
        places, light = np.array([[3.3, -4.1]]), np.array([float(kind == "point")])
    way = np.zeros((frames, 2))
    if kind == "sheet":
        way = (times - times.mean())[:, None] * speed * np.array([0.3, 1.0])
    elif kind == "swaying sheet":
        way[:, 1] = speed * np.sin(2 * np.pi * times / 50)
    clean = []
    for t in times:
        there = places + way[t]
        seen = (np.abs(there) < 0.75 * np.array(STILL_SHAPE)).all(axis=1)
        if kind == "edge of a sheet":
            seen = there[:, 1] < speed * (t - frames / 2)
        fixed = not way.any() and kind != "edge of a sheet"
        clean.append(clean[0] if fixed and clean else camera.light(points(camera, there[seen], light[seen])))
    brightest = max(float(np.max(clean)), 1e-30)
    pictures = solve(psf, [expose(one / brightest, photons, rng) for one in clean], warm=6)
    found = motion(pictures)
    figures = {
        "scene": kind,
        "frames": frames,
        "photons": photons,
        "speed": speed,
        "motion_px": found.largest_px,
    }
    fade = fading(pictures)
    base = baseline(pictures, 300, fade=fade)
    try:
        floor = floor_of(pictures)
    except InputError as error:
        return {**figures, "regions": 0, "refused": str(error)}
    moved = None if found.is_still else found
    search = find_regions(pictures - base, noise=noise_of(pictures), moved=moved)
    return {
        **figures,
        "largest_dff": float(change(pictures, base, floor).max()),
        "faded": 1 - float(fade[-1]),
        "regions": len(search.regions),
        **search.left_out,
    }


NOTHING_ACTIVE = (
    *(("point", frames, photons, 0.0) for frames in (60, 120) for photons in (3e2, 3e3, 1e5)),
    *(("static", frames, photons, 0.0) for frames in (30, 120) for photons in (3e2, 3e3, 1e5)),
    ("noise", 120, 3e3, 0.0),
    *(("sheet", 120, photons, speed) for speed in (0.03, 0.1, 0.3, 1.0) for photons in (3e2, 3e3)),
    *(("swaying sheet", 120, photons, speed) for speed in (0.3, 2.0) for photons in (3e2, 3e3)),
    *(("edge of a sheet", 120, photons, speed) for speed in (0.3, 1.0) for photons in (3e2, 3e3)),
)
"""Scene, frames, photons in the brightest pixel, pixels a frame."""


def _peaks(picture: np.ndarray) -> np.ndarray:
    """Return places (row, column) of a picture's peaks, from the centroid around each."""
    smooth = ndimage.gaussian_filter(picture, 1.0)
    peak = (ndimage.maximum_filter(smooth, 5) == smooth) & (smooth > 0.15 * np.percentile(smooth, 99.9))
    places = []
    for row, column in np.argwhere(peak):
        box = np.s_[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        weight = smooth[box]
        y, x = np.indices(weight.shape) + np.array([box[0].start, box[1].start])[:, None, None]
        places.append((np.average(y, weights=weight), np.average(x, weights=weight)))
    return np.array(places).reshape(-1, 2)


def _linked(found: list[np.ndarray]) -> list[list[tuple[int, np.ndarray]]]:
    """Link places from frame to frame, nearest to where a track's last step leads."""
    done, open_tracks = [], []
    for t, places in enumerate(found):
        ahead = [tr[-1][1] + (tr[-1][1] - tr[-2][1] if len(tr) > 1 else [0.0, 0.8]) for tr in open_tracks]
        taken: dict[int, int] = {}
        if len(ahead) and len(places):
            cost = np.hypot(*(np.array(ahead)[:, None] - places[None]).T).T
            for row, column in zip(*linear_sum_assignment(np.minimum(cost, 50)), strict=True):
                if cost[row, column] <= 2.5:
                    taken[row] = column
        kept = []
        for number, track in enumerate(open_tracks):
            if number in taken:
                track.append((t, places[taken[number]]))
                kept.append(track)
            else:
                done.append(track)
        used = set(taken.values())
        open_tracks = kept + [[(t, place)] for i, place in enumerate(places) if i not in used]
    return done + open_tracks


def _purity(track, truth) -> float:
    """Return the share of a track's places that are those of one bead."""
    names = []
    for t, place in track:
        distance = np.hypot(*(truth[t] - place).T)
        names.append(int(np.argmin(distance)) if distance.min() <= NEAR_PX else -1)
    values, counts = np.unique([n for n in names if n >= 0] or [-2], return_counts=True)
    return 0.0 if values[0] == -2 else float(counts.max()) / len(names)


def figure(path: Path, result, rows: list[dict]) -> None:
    """Draw the default case, and where it breaks."""
    from matplotlib.figure import Figure

    figures, pictures, dff, regions, traces, (places, active) = result
    page = Figure(figsize=(13, 8), layout="constrained")
    swept = [name for name in SWEEPS if any(row["swept"] == name for row in rows)]
    top, bottom = page.subfigures(2, 1)
    grid = top.add_gridspec(1, 4)
    axes = top.add_subplot(grid[0, 0])
    axes.imshow(pictures.mean(axis=0), cmap="gray")
    axes.plot(places[:, 1], places[:, 0], "o", mfc="none", mec="c", ms=9)
    axes.plot([r.centre[1] for r in regions], [r.centre[0] for r in regions], "r+")
    axes.set_title("mean; neurons (o), regions (+)")
    axes = top.add_subplot(grid[0, 1])
    axes.imshow(dff.max(axis=0), cmap="hot", vmax=float(np.percentile(dff.max(axis=0), 99.5)))
    axes.set_title("largest dF/F")
    axes = top.add_subplot(grid[0, 2:])
    for number, region in enumerate(regions[:6]):
        own = int(np.argmin(np.hypot(*(places - region.centre).T)))
        axes.plot(traces[number] + 1.2 * number, "r", lw=0.9)
        axes.plot(active[own] + 1.2 * number, "k", lw=0.7)
    axes.set_title(f"dF/F (red) and truth (black): median correlation {figures['median_correlation']:.3f}")
    places = bottom.subplots(1, max(len(swept), 1), sharey=True, squeeze=False)[0]
    for name, axes in zip(swept, places, strict=False):
        mine = [row for row in rows if row["swept"] == name and not row["align"]]
        values = [row[name] for row in mine]
        for key, style in (("median_correlation", "o-"), ("median_at_true_places", "x:")):
            axes.plot(values, [row[key] for row in mine], style, label=key.replace("_", " "))
        axes.plot(values, [row["found"] / row["of"] for row in mine], "s--", label="share found")
        moved = [row for row in rows if row["swept"] == name and row["align"]]
        if moved:
            axes.plot(
                [r[name] for r in moved], [r["median_correlation"] for r in moved], "v-", label="aligned"
            )
        axes.axhline(0.9, color="0.7", lw=0.8)
        axes.set_xscale("log" if name in ("photons", "neurons") else "linear")
        axes.minorticks_off()
        axes.set_xticks(values, [f"{value:g}" for value in values], rotation=60, fontsize=7)
        axes.set_ylim(0, 1.02)
        axes.set_xlabel(name)
        axes.legend(fontsize=6, loc="lower left")
    page.savefig(path, dpi=90)


def main() -> None:
    """Run the default, the sweeps and the beads."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--sweeps", nargs="*", default=list(SWEEPS))
    parser.add_argument("--no-beads", action="store_true")
    parser.add_argument("--nothing", action="store_true", help="only scenes in which nothing is active")
    parser.add_argument("--out", type=Path, default=Path("activity-benchmark"))
    options = parser.parse_args()
    options.out.mkdir(exist_ok=True)
    set_threads(1)
    print(f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {os.cpu_count()} cores, {platform.machine()}")
    if options.nothing:
        for seed in (0, 1):
            for case in NOTHING_ACTIVE:
                figures = nothing(*case, seed=seed)
                print({k: round(v, 3) if isinstance(v, float) else v for k, v in figures.items()}, flush=True)
        return
    default = neurons(options.frames, **DEFAULT)
    print("default", default[0], flush=True)
    rows = [{"swept": "", **DEFAULT, **default[0]}]
    for name in options.sweeps:
        for value in SWEEPS[name]:
            case = {**DEFAULT, name: value}
            figures = default[0] if case == DEFAULT else neurons(options.frames, **case)[0]
            rows.append({"swept": name, **case, **figures})
            if name == "motion_px" and value > 0:
                moved = neurons(options.frames, **{**case, "align": True})[0]
                rows.append({"swept": name, **case, "align": True, **moved})
                print("aligned", value, {k: round(v, 3) for k, v in moved.items()}, flush=True)
            print(name, value, {k: round(v, 3) for k, v in figures.items()}, flush=True)
    beads = [] if options.no_beads else [flow(60, count, photons)[0] for count, photons in BEADS]
    for row in beads:
        print("beads", {k: round(v, 3) for k, v in row.items()}, flush=True)
    for file_name, table in (("neurons.csv", rows), ("beads.csv", beads)):
        if not table:
            continue
        with (options.out / file_name).open("w", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]))
            writer.writeheader()
            writer.writerows(table)
    figure(options.out / "activity.png", default, rows)


if __name__ == "__main__":
    main()
