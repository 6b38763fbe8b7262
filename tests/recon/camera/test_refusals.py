"""What operators of a camera refuse, in words, and what lies just within."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recon import Calibration
from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures, as_cropped_convolution, split_bayer
from recon.camera.grid import Grid, metric_grid
from recon.camera.transformed import Transformation
from recon.camera.two_part import two_part
from recon.camera.varying_psfs import FieldOfPsfs, interpolation_weights, local_convolution, principal_psfs
from recon.errors import InputError, StructureError
from recon.types import Geometry

RNG = np.random.default_rng(0)
PSF = RNG.random((1, 5, 7)).astype(np.float32)
CAMERA = Convolution(PSF, (8, 9))
FIELD = FieldOfPsfs(RNG.random((4, 1, 5, 7)).astype(np.float32), RNG.random((4, 2)))
OTHER_SIZE = FieldOfPsfs(RNG.random((4, 1, 5, 6)).astype(np.float32), RNG.random((4, 2)))
GRID = Grid((2, 8, 9), (4, 4), np.array([1000.0, 1100.0]), np.array([10.0, 11.0]))
GEOMETRY = Geometry(pixel_pitch_um=5.0, diffuser_distance_mm=4.0)
ONE_PLACE = Calibration(PSF[None], np.array([[0.0, 0.0, 1e5]]), geometry=GEOMETRY)


def glass(tan_y: Any, tan_x: Any) -> Any:
    return np.ones(np.broadcast(tan_y, tan_x).shape)


WITHIN: list[Callable[[], object]] = [
    lambda: Convolution(PSF, (8, 9), grid_shape=(12, 15)),
    lambda: Convolution(PSF, (8, 9), n_channels=3),
    lambda: principal_psfs(FIELD, rank=1),
    lambda: principal_psfs(FIELD, rank=4),
    lambda: Transformation(scale=1e-3),
    lambda: metric_grid(GRID, 40.0),
    lambda: two_part(ONE_PLACE, glass, points=1),
    lambda: split_bayer(np.ones((2, 2)), "BGGR"),
    lambda: as_cropped_convolution(Erasures(np.ones((1, 8, 9), bool), (1, 8, 9), np.float32) @ CAMERA),
]
REFUSED: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: CAMERA @ np.zeros((1, 3, 3), np.float32), ValueError, "Convolution takes arrays of shape"),
    (lambda: CAMERA @ CAMERA, ValueError, "Cannot compose: the outer operator takes"),
    (
        lambda: Erasures(np.ones((1, 8, 9), bool), (1, 8, 9), np.float64) @ CAMERA,
        ValueError, "Cannot compose operators of float64 and float32",
    ),
    (lambda: CAMERA + Convolution(PSF, (8, 10)), ValueError, "Cannot add Convolution and Convolution: their"),
    (
        lambda: CAMERA + Convolution(PSF, (8, 9), dtype=np.float64),
        ValueError, "their dtypes are float32 and float64",
    ),
    (
        lambda: CAMERA + Convolution(PSF[:, :, :6], (8, 10), grid_shape=CAMERA.grid_shape),
        ValueError, "their ranges are",
    ),
    (lambda: Convolution(PSF[0], (8, 9)), InputError, "psfs must be"),
    (lambda: Convolution(PSF[None, None], (8, 9)), InputError, "psfs must be"),
    (lambda: Convolution(PSF[:0], (8, 9)), InputError, "list of depths is empty"),
    (lambda: Convolution(np.repeat(PSF, 2, 0), (8, 9), n_channels=3), InputError, "PSFs of 2 channels"),
    (lambda: Convolution(PSF, (8, 9), grid_shape=(11, 15)), InputError, "does not hold the field"),
    (lambda: Convolution(PSF, (8, 9), grid_shape=(12, 14)), InputError, "does not hold the field"),
    (lambda: Erasures(np.ones((8, 8), bool), (1, 8, 9)), InputError, "of True and False, not (8, 8)"),
    (lambda: as_cropped_convolution(CAMERA.H), StructureError, "needs a Convolution of a picture"),
    (lambda: as_cropped_convolution(Convolution(PSF[None], (8, 9))), StructureError, "of a picture"),
    (lambda: split_bayer(np.ones((4, 4)), "RGBG"), InputError, "'RGBG' is not known"),  # type: ignore[arg-type]
    (lambda: split_bayer(np.ones((1, 4)), "RGGB"), InputError, "at least 2 x 2"),
    (lambda: split_bayer(np.ones((4, 4, 3)), "RGGB"), InputError, "at least 2 x 2"),
    (lambda: metric_grid(replace(GRID, z_um=np.array([5.0, 5.0]))), InputError, "the same depth, 5 um"),
    (lambda: metric_grid(replace(GRID, z_um=np.array([5.0, np.nan]))), InputError, "cannot be brought to"),
    (lambda: metric_grid(GRID, 0.0), InputError, "above 0 um, not 0"),
    (lambda: metric_grid(GRID, np.inf), InputError, "above 0 um, not inf"),
    (lambda: metric_grid(GRID, 199.0), InputError, "two must fit"),
    (lambda: Transformation(columns=np.inf), InputError, "finite numbers"),
    (lambda: Transformation(rotation_deg=np.nan), InputError, "finite numbers"),
    (lambda: Transformation(scale=np.inf), InputError, "positive number, not inf"),
    (lambda: Transformation(scale=0.0), InputError, "positive number, not 0"),
    (lambda: two_part(ONE_PLACE, glass, points=0), InputError, "1 place a side or more, not 0"),
    *(
        (lambda bare=bare: two_part(bare, glass), InputError, "calibration does not say all of them")
        for bare in (
            replace(ONE_PLACE, geometry=replace(GEOMETRY, pixel_pitch_um=None)),
            replace(ONE_PLACE, geometry=replace(GEOMETRY, diffuser_distance_mm=None)),
            replace(ONE_PLACE, source_positions_um=np.array([[0.0, 0.0, np.nan]])),
            replace(ONE_PLACE, source_positions_um=np.array([[0.0, 0.0, 0.0]])),
        )
    ),
    (
        lambda: interpolation_weights(np.zeros((3, 2)), np.eye(2), np.arange(3), np.arange(3)),
        InputError, "2 values do not fit calibration points of shape (3, 2)",
    ),
    (
        lambda: interpolation_weights(np.zeros((3, 3)), np.eye(3), np.arange(3), np.arange(3)),
        InputError, "of shape (3, 3)",
    ),
    (
        lambda: interpolation_weights(np.zeros(3), np.eye(3), np.arange(3), np.arange(3)),
        InputError, "of shape (3,)",
    ),
    (lambda: FieldOfPsfs(FIELD.psfs[:, 0], FIELD.points), InputError, "A field of PSFs is"),
    (lambda: FieldOfPsfs(FIELD.psfs[:0], FIELD.points[:0]), InputError, "A field of PSFs is"),
    (lambda: FieldOfPsfs(FIELD.psfs, FIELD.points[:3]), InputError, "A field of PSFs is"),
    (lambda: local_convolution([], (8, 9)), InputError, "at least one"),
    (lambda: local_convolution([FIELD, OTHER_SIZE], (8, 9)), InputError, "Depth 1 has PSFs of (5, 6)"),
    (
        lambda: local_convolution(
            [FieldOfPsfs(np.repeat(FIELD.psfs, n, 1), FIELD.points) for n in (2, 3)],
            (8, 9),
        ),
        InputError, "channels do not serve",
    ),
    (lambda: principal_psfs(FIELD, rank=0), InputError, "4 PSFs have ranks from 1 to 4, not 0"),
    (lambda: principal_psfs(FIELD, rank=5), InputError, "not 5"),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_it_is_refused_in_words(number: int) -> None:
    call, kind, says = REFUSED[number]
    with pytest.raises(kind, match=re.escape(says)):
        call()


@pytest.mark.parametrize("number", range(len(WITHIN)))
def test_what_lies_just_within_is_taken(number: int) -> None:
    assert WITHIN[number]() is not None
