"""Displacement of a misplaced mask section by section, and the smooth field that goes through it.

Each section of the SLM makes spots of its own, each computed for another local shift of the mask. How bright
they are tells the section's shift (Kuo 2020, Sec. 7.4, moves the mask pattern of 3 x 5 sections by whole
pixels instead); a third-order polynomial through all sections gives shift, rotation and scale, and a smooth
rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.arrays import Array, Float64Array
from recon.errors import InputError
from recon.holography.pose import NODES, Pose, nodes_of
from recon.holography.spots import Spot, SpotMaker

ORDER = 3
"""Of the polynomial: distortion of a lens, centred or not, is third order and what decentring makes of it."""


@dataclass(frozen=True, slots=True)
class Sections:
    """A division of the SLM into ``division`` (rows, columns) sections of nearly equal size."""

    slm_shape: tuple[int, int]
    division: tuple[int, int] = (3, 5)

    def __post_init__(self) -> None:
        if any(d < 2 or n < 4 * d for n, d in zip(self.slm_shape, self.division, strict=True)):
            raise InputError(
                f"An SLM of {self.slm_shape} pixels cannot be divided into {self.division} sections: at "
                "least 2 along each axis, of at least 4 pixels."
            )

    def __len__(self) -> int:
        return self.division[0] * self.division[1]

    def slices(self) -> list[tuple[slice, slice]]:
        """Return rows and columns of the SLM of every section, row by row."""
        edges = [
            [n * i // d for i in range(d + 1)] for n, d in zip(self.slm_shape, self.division, strict=True)
        ]
        return [
            (slice(*edges[0][i : i + 2]), slice(*edges[1][j : j + 2]))
            for i in range(self.division[0])
            for j in range(self.division[1])
        ]

    def basis(self) -> Float64Array:
        """Return the mean of every monomial over every section, (sections, monomials)."""
        height, width = self.slm_shape
        y, x = (2 * (np.arange(n) + 0.5) / width - n / width for n in (height, width))
        terms = [np.multiply.outer(y**i, x**j) for i, j in POWERS]
        return np.array([[term[part].mean() for term in terms] for part in self.slices()])


POWERS = [(i, n - i) for n in range(ORDER + 1) for i in range(n + 1)]
LIKELY = 1.0
"""Size of coefficients of second and third order (mask pixels at the middle of the left and right borders)
that is expected before anything is measured: keeps a field tame between and beyond the sections."""


def likelihood() -> Float64Array:
    """Return the inverse covariance of the monomials before anything is measured of a mask."""
    return np.diag([0.0 if i + j < 2 else LIKELY**-2 for i, j in POWERS])


def hypotheses(step: float) -> Float64Array:
    """Return local shifts (y, x) to try in a section: none, and ``step`` mask pixels each way."""
    return step * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def response(maker: SpotMaker, samples: int = 13) -> tuple[Array, Array]:
    """Return how a spot's amplitude falls with the mask's shift along one axis: shifts (pixels), amplitudes.

    Close to a triangle of half-width one SLM pixel.
    """
    shifts = np.linspace(0, 1.5 * maker.display.factor, samples)
    wanted = np.exp(1j * np.angle(maker.field(Spot(3, 5, Pose()))))
    found = [abs(np.vdot(maker.field(Spot(3, 5, Pose(shift_x=s))), wanted)) for s in shifts]
    return shifts, np.array(found) / found[0]


@dataclass(frozen=True, slots=True)
class SectionShifts:
    """What the spots of every section say.

    Attributes
    ----------
    shift : ndarray, float64, (sections, 2)
        Local displacement (y, x) to add, mask pixels.
    error : ndarray, float64, (sections, 2)
        Standard uncertainty.
    amplitude : ndarray, float64, (sections,)
        Of a spot at the right shift, in the units of the measurement; 0 where nothing was found.
    """

    shift: Float64Array
    error: Float64Array
    amplitude: Float64Array


def fit_shifts(
    amplitudes: Array, tried: Array, noise: float, falling: tuple[Array, Array], limit: float
) -> SectionShifts:
    """Fit every section's shift to its spots' amplitudes with the matched response.

    Parameters
    ----------
    amplitudes : ndarray, (pictures, sections, hypotheses)
    tried : ndarray, (pictures, sections, hypotheses, 2)
        Shifts that the spots assumed, mask pixels.
    noise : float
        Standard deviation of an amplitude.
    falling : (ndarray, ndarray)
        :func:`response`.
    limit : float
        Largest shift believed; a section whose spots ask for more, or are lost in the noise, counts as not
        found and gets an infinite uncertainty.
    """
    n = amplitudes.shape[1]
    shift, error, height = np.zeros((n, 2)), np.full((n, 2), np.inf), np.zeros(n)
    grid = np.linspace(-limit, limit, 41)
    at = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    for s in range(n):
        seen, places = amplitudes[:, s].ravel(), tried[:, s].reshape(-1, 2)

        def model(d: Array, places: Array = places) -> Array:
            away = np.abs(d[..., None, :] - places)
            return np.asarray(np.interp(away, *falling, right=0.0).prod(axis=-1))

        shapes = model(at)
        power = (shapes**2).sum(axis=1)
        gain = (shapes @ seen) ** 2 / np.maximum(power, 1e-9)
        best = int(np.argmax(gain))
        strength = float(shapes[best] @ seen / power[best])
        if gain[best] < (6 * noise) ** 2 or strength <= 0 or np.abs(at[best]).max() >= limit:
            continue
        found = np.array([strength, *at[best]])
        for _ in range(8):
            slope = np.stack(
                [
                    model(found[1:]),
                    *(
                        found[0] * (model(found[1:] + e) - model(found[1:] - e)) / 0.2
                        for e in 0.1 * np.eye(2)
                    ),
                ],
                axis=-1,
            )
            change = np.linalg.lstsq(slope, seen - found[0] * model(found[1:]), rcond=None)[0]
            found += np.r_[change[0], change[1:].clip(-0.5, 0.5)]
        covariance = np.linalg.pinv(slope.T @ slope) * noise**2
        shift[s], error[s], height[s] = found[1:], np.sqrt(np.diag(covariance)[1:]), found[0]
    return SectionShifts(shift, error, height)


@dataclass(frozen=True, slots=True)
class SmoothField:
    """A polynomial displacement field.

    Attributes
    ----------
    change : ndarray, float64, (8,)
        Its shift, rotation and scale, to add to a pose's vector.
    rest : ndarray, float64, (rows, columns, 2)
        What is left of it, on the nodes of :meth:`Pose.displacement`, mask pixels.
    modes : ndarray, float64, (modes, rows, columns, 2)
        One standard deviation of each independent error of the field (rest and all); times the misfit where
        that is above 1.
    error : ndarray, float64, (8,)
        Standard uncertainty of ``change``, with the sections' misfit.
    misfit : float
        Rms of the sections' shifts about the field over their uncertainties; about 1 where it is smooth.
    """

    change: Float64Array
    rest: Float64Array
    modes: Float64Array
    error: Float64Array
    misfit: float


def fit_field(found: SectionShifts, sections: Sections, mask_shape: tuple[int, int]) -> SmoothField:
    """Fit a smooth field through the sections' shifts.

    Parameters
    ----------
    found : SectionShifts
    sections : Sections
    mask_shape : (int, int)

    Raises InputError when fewer than half of the sections were found.
    """
    known = np.isfinite(found.error).all(axis=1)
    if 2 * known.sum() < len(sections):
        raise InputError(
            f"Spots of {int(known.sum())} of {len(sections)} sections of the SLM were seen; half are needed."
        )
    basis = sections.basis()[known]
    y, x = nodes_of(mask_shape)
    half_width = mask_shape[1] / 2
    at_nodes = np.stack([(y / half_width) ** i * (x / half_width) ** j for i, j in POWERS])
    field, modes, chi = np.zeros((*NODES, 2)), [], 0.0
    for axis in range(2):
        weighted = basis / found.error[known, axis, None]
        wanted = found.shift[known, axis] / found.error[known, axis]
        covariance = np.linalg.inv(weighted.T @ weighted + likelihood())
        solution = covariance @ weighted.T @ wanted
        field[..., axis] = np.tensordot(solution, at_nodes, 1)
        chi += float(np.sum((weighted @ solution - wanted) ** 2))
        values, vectors = np.linalg.eigh(covariance)
        for value, vector in zip(values, vectors.T, strict=True):
            mode = np.zeros((*NODES, 2))
            mode[..., axis] = np.tensordot(np.sqrt(max(value, 0)) * vector, at_nodes, 1)
            modes.append(mode)
    free = max(2 * int(known.sum()) - 2 * len(POWERS), 1)
    misfit = float(np.sqrt(chi / free))
    # Sections that lie farther from a smooth field than their noise explains are as uncertain as they lie.
    unsure = np.array(modes) * max(misfit, 1.0)
    change, rest = split_field(field, mask_shape)
    error = np.sqrt(np.sum([split_field(mode, mask_shape)[0] ** 2 for mode in unsure], axis=0))
    return SmoothField(change, rest, unsure, error, misfit)


def split_field(field: Float64Array, mask_shape: tuple[int, int]) -> tuple[Float64Array, Float64Array]:
    """Split a small displacement field into shift, rotation and scale (as a pose's vector) and the rest."""
    y, x = nodes_of(mask_shape, (field.shape[0], field.shape[1]))
    dy, dx = field[..., 0], field[..., 1]
    shift_y, shift_x = float(dy.mean()), float(dx.mean())
    square = float((y**2 + x**2).sum())
    scale = float((y * dy + x * dx).sum()) / square
    roll = float((x * dy - y * dx).sum()) / square
    change = np.zeros(len(Pose().vector()))
    change[:4] = shift_x, shift_y, 1e3 * roll, scale
    rest = field - np.stack([shift_y + scale * y + roll * x, shift_x + scale * x - roll * y], axis=-1)
    return change, rest
