"""Compiled inner loops of :mod:`recon.optics.wave`.

Complex numbers are handled as pairs of floats, and what differs from block to block is written to a row of
its own first: so the compiler turns the loop over the row into vector instructions.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from rocket_fft import c2c

from recon.arrays import Float32Array, Float64Array
from recon.optics.jit import compiled

FloatArray = Float64Array
ComplexArray = npt.NDArray[np.complex64]
Pairs = Float32Array
"""Complex numbers as ``.view(np.float32)``: (h, 2 w), real and imaginary parts in turn."""

# The direction of incidence varies so slowly over the diffuser that it is evaluated every so many samples and
# interpolated between.
BLOCK = 16
COLUMNS = 64
"""That are transformed at a time: they fit into a core's own memory."""


@compiled
def modulate(
    field: Pairs,
    heights: Float32Array,
    row_window: Float32Array,
    column_window: Float32Array,
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

    Number ``[i, j]`` of the field is at sample ``(first_row + i, first_column + j)`` of the height map;
    samples outside it stay untouched. The squared amplitude is the solid angle of a sample seen from the
    source (times the cosine of emission for a Lambertian source) times the squared windows.
    """
    n_rows, n_columns = heights.shape
    begin = max(0, -first_column)
    end = min(column_window.size, n_columns - first_column)
    if end <= begin:
        return
    blocks = (end - begin + BLOCK - 1) // BLOCK
    half_turns = np.empty(blocks * BLOCK, np.float64)
    amplitude = np.empty(blocks * BLOCK, np.float32)
    window = column_window[begin:end]
    for i in range(row_window.size):
        row = first_row + i
        if row < 0 or row >= n_rows or row_window[i] == 0:
            continue
        dy = y - (row - (n_rows - 1) / 2) * pitch
        before = before_amplitude = 0.0
        for block in range(blocks + 1):
            dx = x - (first_column + begin + BLOCK * block - (n_columns - 1) / 2) * pitch
            square = dx * dx + dy * dy
            inverse = 1 / (square + z * z)
            sin_squared = square * inverse
            cos = z * np.sqrt(inverse)
            contrast = np.sqrt(glass_squared - sin_squared) - np.sqrt(ambient_squared - sin_squared)
            solid_angle = cos * inverse * cos if lambertian else cos * inverse
            after = wavenumber / np.pi * contrast
            after_amplitude = row_window[i] * pitch * np.sqrt(solid_angle)
            if block > 0:
                step, amplitude_step = (after - before) / BLOCK, (after_amplitude - before_amplitude) / BLOCK
                for k in range(BLOCK):
                    half_turns[BLOCK * (block - 1) + k] = before + k * step
                    amplitude[BLOCK * (block - 1) + k] = before_amplitude + k * amplitude_step
            before, before_amplitude = after, after_amplitude
        relief = heights[row, first_column + begin : first_column + end]
        _turned(field[i, 2 * begin : 2 * end], half_turns, relief, amplitude, window)


@compiled
def _turned(
    out: Pairs,
    half_turns: FloatArray,
    relief: Float32Array,
    amplitude: Float32Array,
    window: Float32Array,
) -> None:
    """Write ``amplitude window exp(i pi half_turns relief)``."""
    for j in range(len(relief)):
        turned = half_turns[j] * relief[j]
        whole = np.floor(turned + 0.5)
        angle = np.float32(np.pi * (turned - whole))
        square = angle * angle
        # Taylor's series to the eleventh and twelfth power: within 1e-7 on half a turn.
        sine = np.float32(-1 / 39916800) * square + np.float32(1 / 362880)
        sine = sine * square - np.float32(1 / 5040)
        sine = sine * square + np.float32(1 / 120)
        sine = sine * square - np.float32(1 / 6)
        sine = sine * square * angle + angle
        cosine = np.float32(1 / 479001600) * square - np.float32(1 / 3628800)
        cosine = cosine * square + np.float32(1 / 40320)
        cosine = cosine * square - np.float32(1 / 720)
        cosine = cosine * square + np.float32(1 / 24)
        cosine = cosine * square - np.float32(1 / 2)
        cosine = cosine * square + np.float32(1)
        # An odd number of half turns changes the sign.
        size = np.float32(1 - 4 * (0.5 * whole - np.floor(0.5 * whole))) * amplitude[j] * window[j]
        out[2 * j] = size * cosine
        out[2 * j + 1] = size * sine


@compiled
def transform_rows(field: ComplexArray, forward: bool, scale: float) -> None:
    """Transform rows in place, one by one."""
    c2c(field, field, np.array([1]), forward, scale, 1)


@compiled
def propagate(
    field: ComplexArray,
    pairs: Pairs,
    start: int,
    stop: int,
    row_frequencies: FloatArray,
    column_frequencies: FloatArray,
    strength: float,
    tan_squared: float,
    direction_y: float,
    direction_x: float,
) -> None:
    """Take blocks ``start`` to ``stop`` of columns through a stretched distance, their rows transformed.

    A block has ``COLUMNS`` of them, so that results do not depend on threads. They are transformed,
    multiplied by ``exp(-i strength (f . f + tan_squared (f . direction)^2))`` and transformed back (not
    scaled) while they are near; ``pairs`` is the field as floats.
    """
    rows, columns = field.shape
    along, across = np.empty(rows), np.array([0])
    column_real, column_imaginary = np.empty(COLUMNS, np.float32), np.empty(COLUMNS, np.float32)
    # The mixed term turns by the same angle from one column to the next, but for the step down in the middle.
    mixed = -2 * strength * tan_squared * direction_y * direction_x
    step_frequency = column_frequencies[1] if columns > 1 else 0.0
    middle = (columns + 1) // 2
    within_real = np.empty((rows, COLUMNS), np.float32)
    within_imaginary = np.empty((rows, COLUMNS), np.float32)
    for i in range(rows):
        fy = row_frequencies[i]
        along[i] = -strength * fy**2 * (1 + tan_squared * direction_y**2)
        cosine, sine = np.cos(mixed * fy * step_frequency), np.sin(mixed * fy * step_frequency)
        real, imaginary = 1.0, 0.0
        for k in range(COLUMNS):
            within_real[i, k], within_imaginary[i, k] = real, imaginary
            real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
    first = COLUMNS * start
    while first < min(COLUMNS * stop, columns):
        last = min(COLUMNS * (first // COLUMNS + 1), middle if first < middle else columns)
        part = field[:, first:last]
        c2c(part, part, across, True, 1.0, 1)
        for k in range(last - first):
            phase = -strength * column_frequencies[first + k] ** 2 * (1 + tan_squared * direction_x**2)
            column_real[k], column_imaginary[k] = np.cos(phase), np.sin(phase)
        for i in range(rows):
            angle = along[i] + mixed * row_frequencies[i] * column_frequencies[first]
            real32, imaginary32 = np.float32(np.cos(angle)), np.float32(np.sin(angle))
            values = pairs[i, 2 * first : 2 * last]
            for k in range(last - first):
                turn_real = real32 * within_real[i, k] - imaginary32 * within_imaginary[i, k]
                turn_imaginary = real32 * within_imaginary[i, k] + imaginary32 * within_real[i, k]
                both_real = turn_real * column_real[k] - turn_imaginary * column_imaginary[k]
                both_imaginary = turn_real * column_imaginary[k] + turn_imaginary * column_real[k]
                value_real, value_imaginary = values[2 * k], values[2 * k + 1]
                values[2 * k] = value_real * both_real - value_imaginary * both_imaginary
                values[2 * k + 1] = value_real * both_imaginary + value_imaginary * both_real
        c2c(part, part, across, False, 1.0, 1)
        first = last


@compiled
def add_intensity(energy: Float32Array, field: Pairs, weight: float) -> None:
    """Add ``weight |field|^2`` to ``energy``."""
    share = np.float32(weight)
    for i in range(energy.shape[0]):
        values, row = field[i], energy[i]
        for j in range(row.size):
            row[j] += share * (values[2 * j] * values[2 * j] + values[2 * j + 1] * values[2 * j + 1])
