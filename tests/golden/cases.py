"""The golden cases: a name, what makes the result, and how closely it must be met.

Cases reach the project through :mod:`adapter` alone. Runs end by a count of iterations, so that no case hangs
on which side of a threshold a sum of float32 falls; the few that end otherwise have room on both sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from tests.golden import adapter, inputs, steps

SINGLE = 2e-5
"""Relative norm of differences allowed to results of float32 arithmetic. Another order of summation changes a
picture by a few 1e-7; thirty iterations of a splitting method carry that to some 1e-6. A different prior,
weight, scale, step or number of iterations shows at 1e-3 and more."""

DOUBLE = 5e-7
"""Of float64 arithmetic, whose data and pictures are float32 (6e-8)."""

INNER = 1e-3
"""Where conjugate gradients inside each iteration end by a threshold: another processor's BLAS moved such a
picture by 2e-4, all others by less than 1e-5."""

CHAOTIC = 2e-4
"""Of line searches, of scores and of the device's solvers, which carry rounding further."""


@dataclass(frozen=True)
class Case:
    """One golden result.

    Attributes
    ----------
    make : callable
        Returns arrays, numbers and words by name.
    tolerance : float
        Relative norm of the difference that arrays may have; numbers alike. Words and counts are exact.
    """

    make: Callable[[], dict[str, Any]]
    tolerance: float = SINGLE


CASES: dict[str, Case] = {}


def _add(
    name: str, make: Callable[..., dict[str, Any]], *given: Any, within: float = SINGLE, **options: Any
) -> None:
    """Enter a case; arguments that are callables without parameters are called when the case is made."""
    assert name not in CASES, name

    def made() -> dict[str, Any]:
        return make(*(g() if callable(g) else g for g in given), **options)

    CASES[name] = Case(made, within)


photo, psf = inputs.photograph, inputs.psf
colour = partial(inputs.photograph, channels=3)
dense = partial(inputs.photograph, dense=True)
axial, beads = cache(inputs.axial), cache(inputs.beads)
one_depth = partial(axial, 1)
field, field_3d = cache(inputs.over_field), partial(cache(inputs.over_field), 2, (32, 40))
lit = cache(inputs.patterns)
flat_beads = partial(beads, 1, stretch=0.8)
deep_beads = partial(beads, 2, shape=(32, 40), stretch=0.8)
NOISE = adapter.noise_model(inputs.READ_NOISE, 1.0)
PLAIN: dict[str, Any] = {"model": "convolution", "noise": NOISE, "iterations": 25}
SPARSE: dict[str, Any] = {**PLAIN, "prior": "l1", "estimate_background": False, "drop_empty": False}

# Pictures: every method with every prior that it has a way for -------------------------------------------
for method, priors in {
    "admm": ("tv", "tv-isotropic", "l1", "nonnegative", "none"),
    "admm-sensor": ("tv", "tv-isotropic", "l1", "nonnegative", "none"),
    "fista": ("tv", "tv-isotropic", "tv-haar", "l1", "nonnegative", "none"),
}.items():
    for prior in priors:
        _add(f"picture-{method}-{prior}", adapter.picture, photo, psf, method=method, prior=prior, **PLAIN)
for prior in ("tv", "l1"):
    _add(
        f"picture-device-{prior}", adapter.picture_on_device, photo, psf, prior=prior, within=CHAOTIC, **PLAIN
    )
WIENER: dict[str, Any] = {"method": "wiener", "model": "convolution", "noise": NOISE}
_add("picture-wiener", adapter.picture, photo, psf, prior="nonnegative", **WIENER)
_add("picture-wiener-none", adapter.picture, dense, psf, prior="none", **WIENER)
_add("picture-wiener-tau", adapter.picture, photo, psf, prior="nonnegative", tau=0.01, **WIENER)

# Pictures: options ---------------------------------------------------------------------------------------
_add("picture-tau", adapter.picture, photo, psf, tau=3e-3, **PLAIN)
_add("picture-dense", adapter.picture, dense, psf, method="admm-sensor", **PLAIN)
_add("picture-noise-estimated", adapter.picture, photo, psf, model="convolution", iterations=25)
_add("picture-noise-number", adapter.picture, photo, psf, **PLAIN | {"noise": 5.0})
_add("picture-background", adapter.picture, photo, psf, background=inputs.strokes() * 20, **PLAIN)
_add("picture-erasures", adapter.picture, photo, psf, erasures=inputs.erased(), **PLAIN)
_add("picture-colour", adapter.picture, colour, psf, **PLAIN)
_add(
    "picture-colour-erasures",
    adapter.picture,
    colour,
    psf,
    erasures=inputs.erased(),
    method="admm-sensor",
    **PLAIN,
)
_add("picture-field-full", adapter.picture, photo, psf, field="full", **PLAIN)
_add(
    "picture-stop-at-noise",
    adapter.picture,
    photo,
    psf,
    stop_at_noise=True,
    **PLAIN | {"noise": 60.0, "iterations": 60},
)
_add("picture-defaults", adapter.picture, photo, psf, **PLAIN | {"tolerance": None, "iterations": None})
for method in ("admm", "admm-sensor", "fista", "wiener"):
    shared = WIENER | {"prior": "nonnegative"} if method == "wiener" else PLAIN | {"method": method}
    _add(
        f"picture-float64-{method}", adapter.picture, photo, psf, precision="float64", within=DOUBLE, **shared
    )
_add(
    "picture-started",
    adapter.started_picture,
    photo,
    partial(photo, seed=2),
    psf,
    **PLAIN | {"iterations": 12},
)
KEPT: dict[str, Any] = {k: v for k, v in PLAIN.items() if k != "iterations"}
for method in ("admm", "fista"):
    _add(
        f"picture-resumed-{method}",
        adapter.resumed,
        "picture",
        photo,
        psf,
        after=9,
        iterations=20,
        method=method,
        **KEPT,
    )
_add(
    "picture-calibrated",
    adapter.picture,
    beads,
    axial,
    z_um=float(inputs.depths_um(3)[1]),
    prior="l1",
    **PLAIN,
)
_add(
    "picture-patterned",
    adapter.patterned,
    lambda: lit()[0],
    lambda: lit()[1],
    psf,
    noise=NOISE,
    iterations=25,
)
_add(
    "picture-patterned-l1",
    adapter.patterned,
    lambda: lit()[0],
    lambda: lit()[1],
    psf,
    noise=NOISE,
    iterations=25,
    prior="l1",
    tau=0.01,
)


def _files(image: np.ndarray) -> dict[str, np.ndarray]:
    psf_image = np.round(inputs.psf() * 800)
    return {"image": image.clip(0).round().astype(np.uint16), "psf": psf_image.astype(np.uint16)}


STEPS = ("-n", "20", "--tolerance", "0", "--noise", "5")
_add("picture-bayer", adapter.from_files, _files(inputs.mosaic()), "--bayer", "RGGB", "--dark", "100", *STEPS)
_add("picture-files", adapter.from_files, _files(inputs.photograph() + 100), "--bin", "2", *STEPS)

# Pictures: PSFs that vary over the field -----------------------------------------------------------------
for model in ("local", "lowrank"):
    for prior in ("tv", "l1"):
        _add(
            f"picture-{model}-{prior}",
            adapter.picture,
            flat_beads,
            field,
            prior=prior,
            **PLAIN | {"model": model},
        )
_add(
    "picture-local-erasures",
    adapter.picture,
    flat_beads,
    field,
    erasures=inputs.erased(),
    within=INNER,
    **PLAIN | {"model": "local"},
)
_add(
    "picture-lowrank-float64",
    adapter.picture,
    flat_beads,
    field,
    precision="float64",
    within=DOUBLE,
    **PLAIN | {"model": "lowrank"},
)

# Pictures: the program chooses ---------------------------------------------------------------------------
CHOSEN: dict[str, Any] = {"noise": NOISE, "iterations": 25}
_add("picture-auto", adapter.picture, photo, partial(axial, 1), **CHOSEN)
_add("picture-auto-varying", adapter.picture, flat_beads, field, prior="l1", **CHOSEN)
_add(
    "picture-auto-wishes",
    adapter.picture,
    photo,
    partial(axial, 1),
    wishes=adapter.wishes(binning="2", background="on"),
    **CHOSEN,
)

# Volumes -------------------------------------------------------------------------------------------------
for prior in ("tv", "tv-isotropic", "l1", "nonnegative"):
    _add(f"volume-{prior}", adapter.volume, beads, axial, **SPARSE | {"prior": prior})
for prior in ("tv", "l1"):
    _add(
        f"volume-device-{prior}",
        adapter.volume_on_device,
        beads,
        axial,
        within=CHAOTIC,
        **SPARSE | {"prior": prior},
    )
    _add(
        f"volume-float64-{prior}",
        adapter.volume,
        beads,
        axial,
        precision="float64",
        within=DOUBLE,
        **SPARSE | {"prior": prior},
    )
hazy = partial(beads, background=400.0)
_add("volume-tau", adapter.volume, beads, axial, tau=5e-3, **SPARSE)
_add("volume-one-plane", adapter.volume, partial(beads, 1), one_depth, **SPARSE)
_add("volume-background", adapter.volume, hazy, axial, **SPARSE | {"estimate_background": True})
_add(
    "volume-background-tv",
    adapter.volume,
    hazy,
    axial,
    **SPARSE | {"estimate_background": True, "prior": "tv"},
)
_add(
    "volume-positive-background",
    adapter.volume,
    lambda: hazy() - 400,
    axial,
    positive_background=True,
    **SPARSE | {"estimate_background": True},
)
_add(
    "volume-empty-planes",
    adapter.volume,
    partial(beads, 5),
    partial(axial, 5),
    **SPARSE | {"drop_empty": True, "iterations": 30, "tau": 0.05},
)
_add("volume-erasures", adapter.volume, beads, axial, erasures=inputs.erased(), within=INNER, **SPARSE)
_add("volume-colour", adapter.volume, partial(beads, channels=3), axial, **SPARSE | {"iterations": 12})
_add(
    "volume-axis-weights",
    adapter.volume,
    beads,
    axial,
    axis_weights=(0.5, 1.0, 2.0),
    **SPARSE | {"prior": "tv"},
)
_add("volume-field-full", adapter.volume, beads, axial, field="full", **SPARSE | {"prior": "tv"})
_add(
    "volume-stop-at-noise",
    adapter.volume,
    beads,
    axial,
    stop_at_noise=True,
    **SPARSE | {"noise": 45.0, "iterations": 60},
)
_add(
    "volume-started",
    adapter.started_volume,
    beads,
    partial(beads, seed=7),
    axial,
    **SPARSE | {"iterations": 12},
)
_add(
    "volume-resumed",
    adapter.resumed,
    "volume",
    beads,
    axial,
    after=9,
    iterations=20,
    **{k: v for k, v in SPARSE.items() if k != "iterations"},
)
_add("volume-scratch", adapter.scratch_volume, beads, axial, memory_gib=4.65e-3, **SPARSE | {"prior": "tv"})
for model in ("local", "lowrank"):
    for prior in ("tv", "l1"):
        _add(
            f"volume-{model}-{prior}",
            adapter.volume,
            deep_beads,
            field_3d,
            **SPARSE | {"model": model, "prior": prior, "iterations": 15},
        )
_add("volume-auto", adapter.volume, beads, axial, prior="l1", **CHOSEN)
_add("volume-auto-tv", adapter.volume, hazy, axial, prior="tv", **CHOSEN)
_add("volume-auto-varying", adapter.volume, deep_beads, field_3d, prior="l1", **CHOSEN | {"iterations": 12})

# Streams -------------------------------------------------------------------------------------------------
film = partial(cache(inputs.frames), 6)
flat_psf = inputs.psf
_add("video", adapter.video, film, flat_psf, cold=10, warm=3, noise=NOISE)
_add(
    "video-l1-erasures",
    adapter.video,
    film,
    flat_psf,
    cold=10,
    warm=3,
    prior="l1",
    tau=0.01,
    erasures=inputs.erased(),
)
_add("video-joint-tv", adapter.joint, film, flat_psf, "tv", iterations=20)
_add("video-joint-lowrank", adapter.joint, film, flat_psf, "lowrank", weight=2.0, iterations=20)
_add("live", adapter.live, partial(cache(inputs.frames), 3, step=4.0), flat_psf, refinements=3, noise=NOISE)
_add(
    "live-moving",
    adapter.live,
    partial(cache(inputs.frames), 5, step=0.7),
    flat_psf,
    refinements=1,
    noise=NOISE,
)
_add(
    "live-still",
    adapter.live,
    partial(cache(inputs.frames), 4, step=0.0),
    flat_psf,
    refinements=2,
    background=1.0,
)

# Solvers and operators by themselves, in float64 but for what is float32 by its nature ---------------------
for name, way in steps.STEPS.items():
    _add(f"steps-{name}", way, within=DOUBLE)
for name, applied in steps.OPERATORS.items():
    within_float32 = name in ("beads", "in-space", "responding")
    _add(f"operator-{name}", applied, within=SINGLE if within_float32 else DOUBLE)

# Holograms -----------------------------------------------------------------------------------------------
SLM = (32, 40)
shown = [(inputs.shown((64, 80)), 0.0)]
near, far = np.full((64, 80), 0.02), np.full((64, 80), 0.02)
near[10:20, 10:30], far[40:50, 45:60] = 1, 1
_add("hologram", adapter.hologram, shown, SLM, within=CHAOTIC)
_add("hologram-none", adapter.hologram, shown, SLM, loss="none", within=CHAOTIC)
_add("hologram-spatial", adapter.hologram, shown, SLM, loss="spatial", within=CHAOTIC)
_add("hologram-one-step", adapter.hologram, shown, SLM, method="one-step", within=CHAOTIC)
_add("hologram-nesterov", adapter.hologram, shown, SLM, method="nesterov", within=CHAOTIC)
_add("hologram-dissertation-grid", adapter.hologram, shown, SLM, grid="dissertation", within=CHAOTIC)
_add("hologram-frames", adapter.hologram, shown, SLM, frames=2, within=CHAOTIC)
_add("hologram-planes", adapter.hologram, [(near, 0.0), (far, 400.0)], SLM, within=CHAOTIC)
_add("hologram-dc-fill", adapter.hologram, shown, SLM, dc=(0.1, 0.5), mask_fill=0.9, within=CHAOTIC)
_add("hologram-bent-mask", adapter.hologram, shown, SLM, bent=0.7, within=CHAOTIC)
_add("hologram-complex-slm", adapter.hologram, shown, SLM, complex_slm=True, within=CHAOTIC)
_add("hologram-levels", adapter.hologram, shown, SLM, phase_levels=16, within=CHAOTIC)
# Its start is rounded to float32, whose last bit is the processor's: turned at random it moves this by
# 0.9e-6 to 1.8e-6 (six seeds), and from an Intel Xeon to an AMD EPYC it moved by 1.5e-6.
_add("hologram-double", adapter.hologram, shown, SLM, precise=True, within=1e-5)

# A chart and a map ---------------------------------------------------------------------------------------
_add("chart", adapter.chart, "sparse-picture", 32, [
    {"solver": "wiener", "model": "convolution", "prior": "nonnegative"},
    {"solver": "admm", "model": "convolution", "prior": "tv"},
    {"solver": "admm-sensor", "model": "convolution", "prior": "l1"},
    {"solver": "fista", "model": "convolution", "prior": "tv-haar"},
    {"solver": "admm", "model": "convolution", "prior": "l1", "background": True},
], [3, 10, 20], within=CHAOTIC)  # fmt: skip
_add("stability-map", adapter.stability_map, "light-dense", ["wiener"], within=CHAOTIC)
