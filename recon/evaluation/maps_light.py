"""Maps of what reaches the sensor: light and noise, erased and saturated pixels, background; volumes."""

from __future__ import annotations

from dataclasses import replace

from recon.evaluation.scene import SceneSpec
from recon.evaluation.scene_trial import Options, run_scene, spec_at
from recon.verdict.map import Axis, Size, StressMap, Trial

PICTURE = SceneSpec("sparse-picture")
DENSE = SceneSpec("dense-picture", density=0.3)
POINTS = SceneSpec("beads", depths=1, layers=(0.5, 0.5))

ELECTRONS = Axis(
    "photons",
    "light at the brightest pixel",
    "electrons",
    (10, 30, 100, 300, 1000, 3000, 30_000),
    (10, 100, 1000, 10_000),
    logarithmic=True,
)
READ_NOISE = Axis("read_noise_e", "read noise", "electrons", (1, 3, 10, 30, 100), (1, 10, 100), True)
ERASED = Axis("erased", "erased pixels", "share", (0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95), (0, 0.4, 0.8, 0.95))
SATURATED = Axis(
    "saturation",
    "full scale",
    "of the brightest pixel",
    (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0),
    (0.2, 0.4, 0.6, 1.0),
)
BACKGROUND = Axis(
    "background",
    "smooth background",
    "of the scene's mean",
    (0.03, 0.1, 0.3, 1, 3, 10, 30),
    (0.1, 1, 10, 30),
    logarithmic=True,
)
LEFT_OUT = ", left out"
SUBTRACTED = ", subtracted"


def scene_map(
    name: str,
    title: str,
    question: str,
    base: SceneSpec,
    x: Axis,
    y: Axis,
    methods: tuple[str, ...],
    options: Options | None = None,
) -> StressMap:
    """Return a map whose axes are two numbers of a scene, fields of a ``SceneSpec``."""
    chosen = options or Options()

    def trial(method: str, at_x: float, at_y: float, seed: int, size: Size) -> Trial:
        name, used = _handling(method, chosen)
        return run_scene(spec_at(base, size, seed, **{x.key: at_x, y.key: at_y}), name, used, size)

    return StressMap(name, title, question, x, y, methods, trial, base=f"{base} {chosen}")


def _handling(method: str, options: Options) -> tuple[str, Options]:
    """Split a method's name from what is done with the data before."""
    if method.endswith(LEFT_OUT):
        return method.removesuffix(LEFT_OUT), replace(options, leave_out_saturated=True)
    if method.endswith(SUBTRACTED):
        return method.removesuffix(SUBTRACTED), replace(options, subtract_background=True)
    return method, options


BEADS = SceneSpec("beads", depths=4, density=0.4, z_near=3.0, z_far=5.0)
DEPTHS = Axis("depths", "depth planes over the same range", "planes", (2, 4, 8, 12), (2, 8), logarithmic=True)
ROTATION = Axis("drift_deg", "rotation", "degrees", (0.1, 0.3, 0.6, 1, 2, 4), (0.1, 0.5, 2), logarithmic=True)
SWELLING = Axis(
    "drift_scale", "swelling", "relative", (0.001, 0.003, 0.01, 0.03), (0.001, 0.005, 0.02), logarithmic=True
)
FARTHEST = Axis(
    "z_far",
    "farthest plane (nearest: 3)",
    "distances from diffuser to sensor",
    (4, 5, 7, 10, 15),
    (4, 6, 9, 15),
    logarithmic=True,
)


MAPS = (
    scene_map(
        "light",
        "Light and read noise: strokes on black",
        "How much light does a picture on a dark ground need, and how much read noise does it stand?",
        PICTURE,
        ELECTRONS,
        READ_NOISE,
        ("admm tv", "admm l1", "admm-sensor tv", "fista tv", "wiener"),
    ),
    scene_map(
        "light-dense",
        "Light and read noise: a full picture",
        "The same for a picture that fills the field: every pixel carries light from everywhere.",
        DENSE,
        ELECTRONS,
        READ_NOISE,
        ("admm tv", "wiener"),
    ),
    scene_map(
        "light-points",
        "Light and read noise: points",
        "How much light do thirty points need?",
        POINTS,
        ELECTRONS,
        READ_NOISE,
        ("admm l1", "admm tv", "wiener"),
    ),
    scene_map(
        "erasures",
        "Erased pixels and light",
        "What share of the pixels may be missing, with how much light?",
        PICTURE,
        ERASED,
        ELECTRONS,
        ("admm tv", "admm l1"),
    ),
    scene_map(
        "saturation",
        "Saturated pixels and light",
        "How far may a picture be overexposed, when saturated pixels are used as they are, or left out?",
        PICTURE,
        SATURATED,
        ELECTRONS,
        ("admm tv", "admm tv" + LEFT_OUT),
    ),
    scene_map(
        "background",
        "Background and light",
        "How much smooth stray light does a picture stand, when nobody subtracts it, or when it is known?",
        PICTURE,
        BACKGROUND,
        ELECTRONS,
        ("admm tv", "admm l1", "wiener", "admm tv" + SUBTRACTED),
        Options(subtract_background=False),
    ),
    scene_map(
        "background-points",
        "Background and light: points",
        "How much smooth stray light do thirty points stand that nobody subtracts?",
        POINTS,
        BACKGROUND,
        ELECTRONS,
        ("admm l1", "admm tv", "wiener"),
        Options(subtract_background=False),
    ),
    scene_map(
        "light-volume",
        "Light and number of depths: points in a volume",
        "How much light do twelve points in a volume need, and into how many depths may it be divided?",
        BEADS,
        ELECTRONS,
        DEPTHS,
        ("volume l1", "volume tv"),
    ),
    scene_map(
        "light-dense-volume",
        "Light and number of depths: sheets, blobs and threads",
        "The same for a volume that is full of things.",
        SceneSpec("dense-volume", depths=2),
        ELECTRONS,
        DEPTHS,
        ("volume tv", "volume l1"),
    ),
    scene_map(
        "depth-range",
        "Range of depths and light",
        "How far behind the nearest points may others lie? Light falls with the square of the distance.",
        BEADS,
        FARTHEST,
        ELECTRONS,
        ("volume l1", "volume tv"),
    ),
    scene_map(
        "drift-volume",
        "Drift of the diffuser before a volume: rotation and swelling",
        "How far may the diffuser turn and swell before points in a volume are lost?",
        BEADS,
        ROTATION,
        SWELLING,
        ("volume l1", "volume tv"),
    ),
    scene_map(
        "background-volume",
        "Background and light: a volume",
        "How much smooth stray light does a volume stand that nobody subtracts or estimates?",
        BEADS,
        BACKGROUND,
        ELECTRONS,
        ("volume l1", "volume tv"),
        Options(subtract_background=False),
    ),
)
