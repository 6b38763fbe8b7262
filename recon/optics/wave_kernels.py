"""Compiled inner loops of :mod:`recon.optics.wave`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.optics.jit import compiled

FloatArray = npt.NDArray[np.float64]

# The direction of incidence varies so slowly over the diffuser that it is evaluated every so many samples and
# interpolated between.
BLOCK = 16
CIRCLE_STEPS = 4096
CIRCLE = np.exp(2j * np.pi * np.arange(CIRCLE_STEPS + 1) / CIRCLE_STEPS)


@compiled
def modulate(
    field: npt.NDArray[np.complex64],
    heights: npt.NDArray[np.float32],
    row_window: npt.NDArray[np.float32],
    column_window: npt.NDArray[np.float32],
    first_row: int,
    first_column: int,
    pitch: float,
    x: float,
    y: float,
    z: float,
    wavenumber: float,
    glass_squared: float,
    ambient_squared: float,
    lambertian: bool,
) -> None:
    """Write the light behind the diffuser, its spherical curvature removed, into ``field``.

    ``field[i, j]`` is at sample ``(first_row + i, first_column + j)`` of the height map; samples outside it
    stay untouched. The squared amplitude is the solid angle of a sample seen from the source (times the
    cosine of emission for a Lambertian source) times the squared windows.
    """
    n_rows, n_columns = heights.shape
    begin = max(0, -first_column)
    end = min(column_window.size, n_columns - first_column)
    turns_per_um = wavenumber / (2 * np.pi)
    for i in range(row_window.size):
        row = first_row + i
        if row < 0 or row >= n_rows or row_window[i] == 0:
            continue
        dy = y - (row - (n_rows - 1) / 2) * pitch
        next_contrast = 0.0
        next_amplitude = 0.0
        contrast_step = 0.0
        amplitude_step = 0.0
        for j in range(begin, end):
            if (j - begin) % BLOCK == 0:
                for ahead in range(2):
                    # At the start of a row both ends of the block are new, later only the far one.
                    if ahead == 0 and j > begin:
                        continue
                    dx = x - (first_column + j + BLOCK * ahead - (n_columns - 1) / 2) * pitch
                    square = dx * dx + dy * dy
                    inverse = 1 / (square + z * z)
                    sin_squared = square * inverse
                    cos = z * np.sqrt(inverse)
                    contrast = np.sqrt(glass_squared - sin_squared) - np.sqrt(ambient_squared - sin_squared)
                    solid_angle = cos * inverse
                    if lambertian:
                        solid_angle *= cos
                    amplitude = pitch * np.sqrt(solid_angle)
                    if ahead == 0:
                        next_contrast = contrast
                        next_amplitude = amplitude
                    else:
                        contrast_step = (contrast - next_contrast) / BLOCK
                        amplitude_step = (amplitude - next_amplitude) / BLOCK
            turns = turns_per_um * next_contrast * heights[row, first_column + j]
            position = (turns - np.floor(turns)) * CIRCLE_STEPS
            nearest = int(position + 0.5)
            rest = (position - nearest) * (2 * np.pi / CIRCLE_STEPS)
            phasor = CIRCLE[nearest] * complex(1 - rest * rest / 2, rest)
            field[i, j] = phasor * (next_amplitude * row_window[i] * column_window[j])
            next_contrast += contrast_step
            next_amplitude += amplitude_step


@compiled
def propagate(
    spectrum: npt.NDArray[np.complex64],
    row_frequencies: FloatArray,
    column_frequencies: FloatArray,
    strength: float,
    tan_squared: float,
    direction_y: float,
    direction_x: float,
) -> None:
    """Multiply by the transfer function of the stretched distance, in place.

    ``exp(-i strength (f . f + tan_squared (f . direction)^2))``, frequencies in the order of the FFT.
    """
    columns = column_frequencies.size
    column_phasors = np.empty(columns, np.complex128)
    for j in range(columns):
        phase = -strength * column_frequencies[j] ** 2 * (1 + tan_squared * direction_x**2)
        column_phasors[j] = complex(np.cos(phase), np.sin(phase))
    mixed = -2 * strength * tan_squared * direction_y * direction_x
    step_frequency = column_frequencies[1] if columns > 1 else 0.0
    for i in range(row_frequencies.size):
        fy = row_frequencies[i]
        phase = -strength * fy**2 * (1 + tan_squared * direction_y**2)
        row_phasor = complex(np.cos(phase), np.sin(phase))
        if mixed == 0.0:
            for j in range(columns):
                spectrum[i, j] *= row_phasor * column_phasors[j]
            continue
        # The mixed term turns by the same angle from one column to the next.
        turn = complex(np.cos(mixed * fy * step_frequency), np.sin(mixed * fy * step_frequency))
        phasor = row_phasor
        for j in range(columns):
            if j == (columns + 1) // 2:
                back = mixed * fy * column_frequencies[j]
                phasor = row_phasor * complex(np.cos(back), np.sin(back))
            spectrum[i, j] *= phasor * column_phasors[j]
            phasor *= turn


@compiled
def add_intensity(energy: npt.NDArray[np.float32], field: npt.NDArray[np.complex64], weight: float) -> None:
    """Add ``weight |field|^2`` to ``energy``."""
    for i in range(energy.shape[0]):
        for j in range(energy.shape[1]):
            value = field[i, j]
            energy[i, j] += weight * (value.real * value.real + value.imag * value.imag)
