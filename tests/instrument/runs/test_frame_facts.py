"""What a run's image tells other programs of its frames: steps, start, window, and facts of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.frame import FrameMetadata
from instrument.runs.frame_facts import descriptions, z_steps_um
from instrument.runs.run_files import RunError
from tests.instrument.runs.test_store import metadata

Place = Mapping[str, float]


def noted(*places: Place) -> list[FrameMetadata]:
    """Return metadata of frames at places, half a second apart, a little dimmer each."""
    return [
        replace(
            metadata(n),
            stage_position=place,
            host_time_ns=7_000_000_000 + 500_000_000 * n,
            exposure_ms=10.0 - n,
            led_pattern=f"pattern {n}",
        )
        for n, place in enumerate(places)
    ]


def along_z(*z_um: float, **others: float) -> list[Place]:
    return [{"z_um": z, **others} for z in z_um]


def told(
    frames: Mapping[int, FrameMetadata],
    *,
    plan: bool = True,
    dtype: str = "uint16",
    provenance: Mapping[str, Any] | None = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what is told of a run of four frames, by number: its array, and its image's attributes."""
    run: Any = SimpleNamespace(
        path=Path("r"),
        label="r",
        array=SimpleNamespace(frame_shape=(6, 8), dtype=np.dtype(dtype), is_colour=False),
        records={n: SimpleNamespace(metadata=one) for n, one in reversed(frames.items())},
        plan=object() if plan else None,
        frame_period_s=None if plan else 0.25,
        provenance={"pixel_pitch_um": 6.5} if provenance is None else provenance,
        is_simulated=True,
    )
    array, group = descriptions(run, 4)
    return array, group["attributes"]


def scale_and_start(attributes: Mapping[str, Any]) -> tuple[float, float | None]:
    """Return step and first place along the frames' axis."""
    scale, *shift = attributes["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"]
    return scale["scale"][0], shift[0]["translation"][0] if shift else None


@pytest.mark.parametrize(
    ("places", "steps"),
    [
        (along_z(1, 3, 6), [2, 3]),
        (along_z(6, 3.5, 3, x_um=5), [-2.5, -0.5]),
        (along_z(1, 1.5), [0.5]),
        (along_z(1, 3, 3), []),
        (along_z(3, 3, 1), []),
        (along_z(1, 3, 2), []),
        ([{"z_um": 1, "x_um": 0}, {"z_um": 2, "x_um": 1}], []),
        ([{"z_um": 1, "x_um": 0}, {"x_um": 0}, {"z_um": 3, "x_um": 0}], []),
        ([{"x_um": 0}, {"x_um": 0}], []),
    ],
)
def test_a_sweep_is_along_z_alone_and_goes_one_way(places: Sequence[Place], steps: list[float]) -> None:
    assert list(z_steps_um(noted(*places))) == steps


@pytest.mark.parametrize(
    ("z_um", "numbers", "axis", "step_um", "start_um"),
    [
        ((10, 12, 14, 16), (0, 1, 2, 3), "z", 2, 10),
        ((10, 10.5, 11, 11.5), (0, 1, 2, 3), "z", 0.5, 10),
        ((10, 12, 14), (1, 2, 3), "z", 2, None),  # where the first frame would be is not known
        ((16, 14, 12, 10), (0, 1, 2, 3), "z", 2, None),  # a scale is positive
        ((10, 12, 14, 17), (0, 1, 2, 3), "z", 1, None),  # no one step
        ((10, 110, 211), (0, 1, 2), "z", 100.5, 10),  # a hundredth more
        ((10, 110, 211.005), (0, 1, 2), "z", 1, None),
        ((10, 12), (0, 1), "z", 2, 10),
        ((10, 12, 12, 16), (0, 1, 2, 3), "t", 1, None),
    ],
)
def test_an_even_sweeps_step_and_start_are_told(
    z_um: Sequence[float], numbers: Sequence[int], axis: str, step_um: float, start_um: float | None
) -> None:
    array, attributes = told(dict(zip(numbers, noted(*along_z(*z_um)), strict=True)))
    assert array["dimension_names"] == [axis, "y", "x"]
    assert array["shape"] == [4, 6, 8]
    assert scale_and_start(attributes) == (step_um, start_um)


def test_a_recordings_frames_are_in_time_wherever_the_stage_was() -> None:
    frames = dict(enumerate(noted(*along_z(1, 2, 3))))
    array, attributes = told(frames, plan=False)
    assert array["dimension_names"] == ["t", "y", "x"]
    assert scale_and_start(attributes) == (0.25, None)
    assert "frames" not in attributes["diffuserbench"]


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_the_window_is_the_bit_depth_of_counts_and_means_have_none(bits: int) -> None:
    frames = {0: replace(metadata(), significant_bits=bits)}
    window = {"min": 0, "start": 0, "max": 2**bits - 1, "end": 2**bits - 1}
    (channel,) = told(frames)[1]["ome"]["omero"]["channels"]
    assert channel["window"] == window
    assert "omero" not in told(frames, dtype="float32")[1]["ome"]


def test_each_frame_of_a_plan_is_told_of_and_what_is_common_once() -> None:
    places = [{"z_um": 5.0, "x_um": 1.0}, {"z_um": float("nan")}, {"z_um": 5.0, "x_um": 3.0}]
    facts = told(dict(zip((0, 1, 3), noted(*places), strict=True)))[1]["diffuserbench"]
    assert facts["frames"] == {
        "time_s": [0.0, 0.5, None, 1.0],
        "exposure_ms": [10.0, 9.0, None, 8.0],
        "led_pattern": ["pattern 0", "pattern 1", None, "pattern 2"],
        "slm_image_hash": ["", "", None, ""],
        "x_um": [1.0, None, None, 3.0],
        "z_um": [5.0, None, None, 5.0],
    }
    assert facts["exposure_ms"] is None, "frames differ"
    assert (facts["pixel_format"], facts["roi"], facts["black_level"]) == ("Mono12", [0, 0, 6, 8], 30.0)
    assert (facts["simulated"], facts["began_utc"]) == (True, metadata().utc.isoformat())


@pytest.mark.parametrize("provenance", [{}, {"pixel_pitch_um": "wide"}, {"pixel_pitch_um": None}])
def test_a_run_without_a_pitch_says_where_it_is_expected(provenance: dict[str, Any]) -> None:
    with pytest.raises(RunError, match=r"r/provenance.json: is damaged: pixel_pitch_um"):
        told({0: metadata()}, provenance=provenance)
