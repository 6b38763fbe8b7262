"""The scenes of the auto-model benchmark: what it was tuned on, and what it is judged by.

No seed that judges was ever tuned on. The kinds that judge were fixed before anything was tuned. Runs on
them with seeds 101 to 128, 701 to 728 and 801 to 828 had shown which miss, so the kinds of both lists were
tuned on with other seeds (tuning list: ``--seed-offset`` 0, 1000, 2000, 3000, 5000; this list: seeds 1101 to
1128, 3101 to 3128 and 5101 to 5128). Those that judge are new, and three of each kind: one more or less is
chance.

Kinds named ``hand`` and ``usaf`` are rendered through the PSFs of the measured sets, with stray light as it
lies on their photographs: they need the data (``DIFFUSERBENCH_DATA``, or ``../shared/data``).
"""

from __future__ import annotations

from typing import Any

from recon.evaluation.scene import FAMILIES, Family, SceneSpec, spec_of

P, S, B, D, M = "dense-picture", "sparse-picture", "beads", "dense-volume", "microscope"
FAMILY_PRIOR = {family: "l1" if family == B else "tv" for family in FAMILIES}

HAND = {"optics": "hand", "size": (45, 60), "field": 0.65}
USAF = {"optics": "usaf", "size": (45, 53), "field": 0.65}

TUNING: tuple[tuple[str, SceneSpec], ...] = tuple(
    (name, spec_of(family, seed=seed, **changes))
    for seed, (name, family, changes) in enumerate(
        [
            ("t-dense-plain", P, {"grid": 3}),
            ("t-dense-fall-off", P, {"grid": 5, "fall_off_deg": 18.0}),
            ("t-dense-noisy", P, {"grid": 5, "fall_off_deg": 22.0, "photons": 300.0}),
            ("t-sparse-aberrated", S, {"grid": 5, "aberration": 3.0}),
            ("t-sparse-stray", S, {"grid": 3, "background": 0.8}),
            ("t-sparse-soft", S, {"grid": 3, "spot_px": 2.2}),
            ("t-beads-one-layer", B, {"size": 40, "depths": 6, "grid": 3, "layers": (0.5, 0.8)}),
            ("t-beads-fall-off", B, {"size": 40, "depths": 6, "grid": 3, "fall_off_deg": 18.0}),
            ("t-beads-stray", B, {"size": 40, "depths": 6, "grid": 3, "background": 0.6}),
            ("t-volume", D, {"size": 40, "depths": 5, "grid": 3}),
            ("t-volume-fall-off", D, {"size": 40, "depths": 5, "grid": 3, "fall_off_deg": 18.0}),
            ("t-microscope", M, {"size": 40, "depths": 5, "grid": 3}),
            ("t-dense-wide", P, {"grid": 5, "field": 1.2, "fall_off_deg": 20.0, "photons": 6000.0}),
            ("t-dense-wide-plain", P, {"grid": 3, "field": 1.4}),
            ("t-dense-bright", P, {"grid": 3, "photons": 2e4, "density": 0.6}),
            ("t-sparse-dim", S, {"grid": 3, "photons": 400.0}),
            ("t-sparse-softer", S, {"grid": 3, "spot_px": 3.0, "photons": 4000.0}),
            ("t-sparse-erased", S, {"grid": 3, "erased": 0.5}),
            ("t-beads-many", B, {"size": 40, "depths": 6, "grid": 3, "density": 2.0}),
            ("t-beads-few", B, {"size": 48, "depths": 6, "grid": 3, "density": 0.4}),
            ("t-beads-dim", B, {"size": 40, "depths": 6, "grid": 3, "photons": 120.0, "fall_off_deg": 16.0}),
            ("t-volume-layer", D, {"size": 40, "depths": 6, "grid": 3, "layers": (0.2, 0.5)}),
            ("t-volume-dim", D, {"size": 40, "depths": 5, "grid": 3, "photons": 500.0}),
            ("t-microscope-thin", M, {"size": 40, "depths": 6, "grid": 3, "layers": (0.6, 0.8)}),
            ("t-microscope-dim", M, {"size": 40, "depths": 5, "grid": 3, "photons": 400.0}),
            ("t-dense-wider", P, {"grid": 5, "field": 1.35, "fall_off_deg": 26.0}),
            ("t-dense-wide-bright", P, {"grid": 5, "field": 1.3, "fall_off_deg": 23.0, "photons": 8000.0}),
            ("t-hand-text", "text", {**HAND, "grid": 3, "aberration": 0.1}),
            ("t-hand-stray", "filaments", {**HAND, "grid": 3, "background": 0.4}),
            ("t-usaf-texture", "texture", {**USAF, "grid": 3, "fall_off_deg": 20.0}),
            ("t-usaf-saturated", S, {**USAF, "grid": 3, "saturation": 0.8, "drift_scale": 0.003}),
            ("t-usaf-beads", B, {**USAF, "depths": 6, "grid": 1, "background": 0.4}),
            ("t-usaf-volume", D, {**USAF, "depths": 5, "grid": 3, "aberration": 0.05}),
        ],
        start=1,
    )
)

_KINDS: tuple[tuple[str, Family, dict[str, Any]], ...] = (
    # Pictures, from easy to hard.
    ("sparse-bright", S, {"grid": 3, "photons": 2e4}),
    ("sparse-dim", S, {"grid": 3, "photons": 250.0}),
    ("sparse-fall-off", S, {"grid": 5, "fall_off_deg": 15.0}),
    ("sparse-aberrated", S, {"grid": 5, "aberration": 5.0, "photons": 8000.0}),
    ("sparse-erased", S, {"grid": 3, "erased": 0.4, "fall_off_deg": 20.0}),
    ("sparse-stray", S, {"grid": 3, "background": 0.5, "photons": 1500.0}),
    ("sparse-soft", S, {"grid": 3, "spot_px": 2.5, "photons": 6000.0}),
    ("sparse-colour", S, {"size": 48, "grid": 3, "channels": 3}),
    ("dense", P, {"grid": 3, "photons": 8000.0}),
    ("dense-dim", P, {"grid": 5, "fall_off_deg": 16.0, "photons": 500.0}),
    ("dense-fall-off", P, {"grid": 5, "fall_off_deg": 14.0, "photons": 1e4}),
    ("dense-wide", P, {"grid": 5, "field": 1.3, "fall_off_deg": 24.0}),
    ("dense-smooth-diffuser", P, {"size": 48, "grid": 3, "optics": "smooth"}),
    # Beads in a volume.
    ("beads", B, {"size": 40, "depths": 6, "grid": 3, "photons": 2000.0}),
    ("beads-few", B, {"size": 48, "depths": 6, "grid": 3, "density": 0.3}),
    ("beads-many", B, {"size": 40, "depths": 6, "grid": 3, "density": 2.5}),
    ("beads-layer", B, {"size": 48, "depths": 8, "grid": 3, "layers": (0.1, 0.35)}),
    ("beads-fall-off", B, {"size": 40, "depths": 6, "grid": 3, "fall_off_deg": 14.0}),
    ("beads-dim", B, {"size": 40, "depths": 6, "grid": 3, "photons": 60.0, "fall_off_deg": 20.0}),
    ("beads-stray", B, {"size": 40, "depths": 6, "grid": 3, "background": 1.0}),
    # Volumes that are full of things.
    ("volume", D, {"size": 40, "depths": 5, "grid": 3, "density": 0.7}),
    ("volume-layer", D, {"size": 40, "depths": 6, "grid": 3, "layers": (0.55, 0.9)}),
    ("volume-fall-off", D, {"size": 40, "depths": 5, "grid": 3, "fall_off_deg": 15.0}),
    ("volume-dim", D, {"size": 40, "depths": 5, "grid": 3, "photons": 300.0, "density": 1.5}),
    # Under the microscope: fall-off and stray light by default.
    ("microscope", M, {"size": 40, "depths": 5, "grid": 3, "photons": 6000.0}),
    ("microscope-dim", M, {"size": 40, "depths": 5, "grid": 3, "photons": 250.0}),
    ("microscope-thin", M, {"size": 40, "depths": 6, "grid": 3, "layers": (0.3, 0.5)}),
    ("microscope-clean", M, {"size": 40, "depths": 5, "grid": 3, "background": 0.0}),
    # Through measured PSFs.
    ("hand-text", "text", {**HAND, "grid": 3}),
    ("hand-dense", P, {**HAND, "grid": 3, "aberration": 0.08, "photons": 2000.0}),
    ("hand-stray", "sparse-picture", {**HAND, "grid": 3, "background": 0.6, "calibration_photons": 3000.0}),
    ("hand-drift", "filaments", {**HAND, "grid": 3, "drift_scale": 0.004, "photons": 1500.0}),
    ("usaf-gradient", "gradient", {**USAF, "grid": 3, "fall_off_deg": 18.0}),
    ("usaf-lights", "lights", {**USAF, "grid": 3, "aberration": 0.1, "saturation": 0.9}),
    ("usaf-beads", B, {**USAF, "depths": 6, "grid": 1}),
    ("usaf-beads-stray", B, {**USAF, "depths": 6, "grid": 3, "background": 0.8, "aberration": 0.05}),
    ("usaf-volume", D, {**USAF, "depths": 5, "grid": 3, "aberration": 0.05, "photons": 2000.0}),
)

ROUNDS = 3
JUDGED: tuple[tuple[str, SceneSpec], ...] = tuple(
    (f"{name} {turn + 1}", spec_of(family, seed=10_001 + 100 * turn + kind, **changes))
    for turn in range(ROUNDS)
    for kind, (name, family, changes) in enumerate(_KINDS)
)
