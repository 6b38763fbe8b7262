"""Light of a scene on a large sensor is on disk the next time, and only where it is the same light."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.simulated import kept_light, world
from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.arrays import Float32Array
from recon.optics.scene import Scene, picture

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Every sensor's light is worth a file, in a cache of the test's own."""
    monkeypatch.setattr(kept_light, "WORTH_PIXELS", 1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "diffuserbench" / "light"


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Count scenes that are rendered: by numbers of their own instead of optics."""
    made: list[object] = []

    def render(
        scene: Scene, _weights: object, grid: object, *_optics: object, **_rest: object
    ) -> Float32Array:
        made.append(scene)
        shape = grid.shape  # type: ignore[attr-defined]
        return np.random.default_rng(len(made)).random(shape, np.float32)

    monkeypatch.setattr(world, "render", render)
    return made


def lit(**options: object) -> SimulatedWorld:
    """Return a small world whose scene glows."""
    found = SimulatedWorld(WorldOptions.model_validate({"preset": "tiny", "time_scale": 0.0, **options}))
    found.scene_lit = True
    return found


def light(of: SimulatedWorld, binning: int = 1) -> Float32Array:
    found = of.photons_per_s(WHITE, binning)
    assert found is not None
    return found


def test_the_next_start_finds_the_light_to_the_last_bit_and_computes_nothing(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    first = light(lit())
    assert len(list(folder.iterdir())) == 1
    monkeypatch.setattr(world, "render", None)
    np.testing.assert_array_equal(light(lit(noise=0.0, flicker=0.1)), first)  # they come after the light


@pytest.mark.parametrize(
    "options",
    [
        {"seed": 1},
        {"diffuser_seed": 5},
        {"scene": "bars"},
        {"scene_rgb": (0.5, 1.0, 1.0)},
        {"diffuser_distance_mm": 8.0},
        {"fall_off": "gaussian"},
        {"spectral_samples": 2},
    ],
)
def test_other_light_is_computed(rendered: list[object], options: dict[str, object]) -> None:
    light(lit())
    light(lit())
    assert len(rendered) == 1
    light(lit(**options))
    assert len(rendered) == 2


def test_another_picture_another_grid_and_another_program_have_light_of_their_own(
    rendered: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = lit()
    light(first)
    light(first, 2)
    assert len(rendered) == 2
    assert first.scene is not None
    layer = first.scene.layers[0]
    other = layer.radiance.copy()
    other[0, 0, 0] += 1e-3
    first.set_scene(replace(first.scene, layers=(replace(layer, radiance=other),)))
    light(first)
    assert len(rendered) == 5  # in three colours, as it is grey no more
    monkeypatch.setattr(kept_light, "_program", lambda: "another")
    light(lit())
    assert len(rendered) == 6


def test_a_damaged_file_is_computed_anew_and_a_folder_that_cannot_be_made_hinders_nothing(
    rendered: list[object], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    light(lit())
    (file,) = folder.iterdir()
    whole = bytearray(file.read_bytes())
    whole[len(whole) // 2] ^= 1
    file.write_bytes(whole)
    light(lit())
    assert len(rendered) == 2
    file.write_bytes(whole[:1000])
    light(lit())
    light(lit())
    assert len(rendered) == 3
    (folder.parent.parent / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder.parent.parent / "file"))
    light(lit())
    assert len(rendered) == 4


def test_what_was_used_longest_ago_makes_room(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = np.ones((10, 10), np.float32)
    for number, name in enumerate("abc"):
        kept_light.keep(name, kept)
        os.utime(folder / f"{name}.npz", (number, number))
    assert kept_light.kept("a") is not None  # used just now
    monkeypatch.setattr(kept_light, "MOST_BYTES", 3 * (folder / "a.npz").stat().st_size)
    kept_light.keep("d", kept)
    assert {path.stem for path in folder.iterdir()} == {"a", "c", "d"}


def test_small_sensors_leave_nothing_on_disk(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder.parent.parent))
    found = lit()
    found.set_scene(picture(np.ones((2, 2)), 1e5, 1e3))
    light(found)
    assert not folder.exists()


def test_nothing_is_shown_coarsely_that_is_there(
    rendered: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world, "COARSE_PIXELS", 1200)
    assert lit().coarse_photons_per_s(WHITE) is not None
    light(lit())
    assert len(rendered) == 2
    assert lit().coarse_photons_per_s(WHITE) is None
