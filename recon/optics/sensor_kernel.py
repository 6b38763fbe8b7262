"""Compiled loop over a sensor's pixels, with the random numbers that it draws.

SplitMix64, normal deviates by the ziggurat, Poisson deviates. A stream is one 64-bit state; every function
takes it and returns it advanced, so that each row has its own stream.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array, Float64Array
from recon.optics.jit import compiled

LAYERS = 128
# Marsaglia and Tsang 2000: the last layer's border and the area of every layer.
TAIL = 3.442619855899
AREA = 9.91256303526217e-3
EXPANSION_FROM = 30.0
"""Mean from which Poisson deviates come from a normal one (Cornish-Fisher, third order)."""


def _ziggurat() -> tuple[npt.NDArray[np.int64], Float64Array, Float64Array]:
    """Borders as integers, widths per integer step, and densities of the layers."""
    scale = 2.0**31
    border, width, density = np.zeros(LAYERS, np.int64), np.zeros(LAYERS), np.zeros(LAYERS)
    edge = previous = TAIL
    base = AREA / math.exp(-0.5 * edge * edge)
    border[0], border[1] = int(edge / base * scale), 0
    width[0], width[-1] = base / scale, edge / scale
    density[0], density[-1] = 1.0, math.exp(-0.5 * edge * edge)
    for layer in range(LAYERS - 2, 0, -1):
        edge = math.sqrt(-2.0 * math.log(AREA / edge + math.exp(-0.5 * edge * edge)))
        border[layer + 1] = int(edge / previous * scale)
        previous = edge
        density[layer] = math.exp(-0.5 * edge * edge)
        width[layer] = edge / scale
    return border, width, density


BORDER, WIDTH, DENSITY = _ziggurat()


@compiled
def advance(state: np.uint64) -> np.uint64:
    """Return the next state."""
    return np.uint64(state + np.uint64(0x9E3779B97F4A7C15))


@compiled
def word_of(state: np.uint64) -> np.uint64:
    """64 random bits of a state."""
    word = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.uint64(word ^ (word >> np.uint64(31)))


@compiled
def stream(seed: np.uint64, row: int) -> np.uint64:
    """Return the state of a row's own stream; rows of different seeds have nothing in common."""
    return np.uint64(word_of(advance(seed)) ^ word_of(np.uint64(row) * np.uint64(0xD1342543DE82EF95)))


@compiled
def uniform_of(word: np.uint64) -> float:
    """Return a number between 0 and 1, both excluded, from the upper 53 bits."""
    return (float(word >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@compiled
def normal(bits: np.uint64, state: np.uint64) -> tuple[float, np.uint64]:
    """Return a standard normal deviate from 32 random bits, and the state, advanced if they did not do."""
    while True:
        signed = np.int64(bits & np.uint64(0xFFFFFFFF)) - np.int64(0x80000000)
        layer = signed & np.int64(LAYERS - 1)
        value = signed * WIDTH[layer]
        if abs(signed) < BORDER[layer]:
            return value, state
        if layer == 0:
            # Beyond the last border: Marsaglia's tail.
            while True:
                state = advance(state)
                x = -np.log(uniform_of(word_of(state))) / TAIL
                state = advance(state)
                y = -np.log(uniform_of(word_of(state)))
                if y + y > x * x:
                    return (TAIL + x if signed > 0 else -TAIL - x), state
        state = advance(state)
        height = DENSITY[layer] + uniform_of(word_of(state)) * (DENSITY[layer - 1] - DENSITY[layer])
        if height < np.exp(-0.5 * value * value):
            return value, state
        state = advance(state)
        bits = word_of(state)


@compiled
def poisson_small(mean: float, uniform: float) -> float:
    """Poisson deviate by inversion, for means up to some tens."""
    term = np.exp(-mean)
    total = term
    count = 0.0
    while uniform > total and count < 400.0:
        count += 1.0
        term *= mean / count
        total += term
    return count


@compiled
def expose_pixels(
    electrons_per_s: Float32Array,
    response: Float32Array,
    dark_e_per_s: Float32Array,
    offset_e: Float32Array,
    exposure_s: float,
    counts_per_electron: float,
    black_level: float,
    full_scale: int,
    full_well_e: float,
    read_noise_e: float,
    noise_scale: float,
    seed: np.uint64,
    counts: npt.NDArray[np.uint16],
    start: int,
    stop: int,
) -> None:
    """Write the counts of one exposure's rows; see :mod:`recon.optics.sensor` for the model."""
    width = counts.shape[1]
    for i in range(start, stop):
        # One stream a row, so that a row's noise does not depend on what came before it.
        state = stream(seed, i)
        for j in range(width):
            mean = (electrons_per_s[i, j] * response[i, j] + dark_e_per_s[i, j]) * exposure_s
            state = advance(state)
            word = word_of(state)
            read, state = normal(word >> np.uint64(32), state)
            if noise_scale != 1.0:
                shot, state = normal(word, state)
                charge = mean + noise_scale * np.sqrt(mean) * shot
            elif mean > EXPANSION_FROM:
                shot, state = normal(word, state)
                charge = np.floor(mean + np.sqrt(mean) * shot + (shot * shot - 1.0) / 6.0 + 0.5)
            else:
                state = advance(state)
                charge = poisson_small(mean, uniform_of(word_of(state)))
            charge = min(max(charge, 0.0), full_well_e)
            value = (charge + offset_e[i, j] + noise_scale * read_noise_e * read) * counts_per_electron
            value = np.floor(value + black_level + 0.5)
            counts[i, j] = np.uint16(min(max(value, 0.0), float(full_scale)))
