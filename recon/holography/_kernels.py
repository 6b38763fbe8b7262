"""Compiled inner loops of the hologram model (imported lazily: numba costs half a second to import).

Every loop works on rows ``start`` to ``stop`` and touches nothing else, so that rows can be shared between
threads without changing a result. The arrays of a call share one precision (complex64 or complex128).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from rocket_fft import c2c, c2r, r2c

ROWS_AT_ONCE = 8
"""Rows transformed together: enough for the FFT's vector unit, few enough to stay in the cache."""


@njit(nogil=True, cache=True)
def columns(field: Any, forward: bool, threads: int) -> None:
    """Transform ``field`` along its columns in place, not scaled."""
    c2c(field, field, np.array([0]), forward, 1.0, threads)


@njit(nogil=True, cache=True, fastmath=True)
def fill(
    pairs: Any, slm: Any, mask: Any, table: Any, hy: Any, hx: Any, k: int, start: int, stop: int
) -> None:
    """``field[y, x] = slm[y // k, x // k] * table[mask[y, x]] * hy[y] * hx[x]`` (Eqs. 7.8, 7.15).

    ``pairs`` is the field's real view, parts side by side: loops go through it as vectors.
    """
    width = mask.shape[1]
    one = pairs.dtype.type(1.0)
    re, im = np.empty(width, pairs.dtype), np.empty(width, pairs.dtype)
    seen = -1
    for y in range(start, stop):
        if y // k != seen:
            seen = y // k
            for x in range(width):
                value = slm[seen, x // k] * hx[x]
                re[x], im[x] = value.real, value.imag
        line, levels = pairs[y], mask[y]
        if len(table) == 2:
            first = table[0] * hy[y]
            step = table[1] * hy[y] - first
            for x in range(width):
                m = one * levels[x]
                there, across = first.real + step.real * m, first.imag + step.imag * m
                line[2 * x] = re[x] * there - im[x] * across
                line[2 * x + 1] = re[x] * across + im[x] * there
        else:
            for x in range(width):
                at = table[levels[x]] * hy[y]
                line[2 * x] = re[x] * at.real - im[x] * at.imag
                line[2 * x + 1] = re[x] * at.imag + im[x] * at.real


@njit(nogil=True, cache=True, fastmath=True)
def gather(
    out: Any, pairs: Any, mask: Any, table: Any, hy: Any, hx: Any, k: int, start: int, stop: int
) -> None:
    """Adjoint of :func:`fill`, added to rows ``start`` to ``stop`` of the SLM-sized ``out``."""
    width = mask.shape[1]
    one = pairs.dtype.type(1.0)
    re, im = np.empty(width, pairs.dtype), np.empty(width, pairs.dtype)
    for j in range(start, stop):
        re[:] = 0
        im[:] = 0
        for y in range(j * k, (j + 1) * k):
            line, levels = pairs[y], mask[y]
            if len(table) == 2:
                first = table[0] * hy[y]
                step = table[1] * hy[y] - first
                for x in range(width):
                    m = one * levels[x]
                    there, across = first.real + step.real * m, first.imag + step.imag * m
                    re[x] += line[2 * x] * there + line[2 * x + 1] * across
                    im[x] += line[2 * x + 1] * there - line[2 * x] * across
            else:
                for x in range(width):
                    at = table[levels[x]] * hy[y]
                    re[x] += line[2 * x] * at.real + line[2 * x + 1] * at.imag
                    im[x] += line[2 * x + 1] * at.real - line[2 * x] * at.imag
        for i in range(out.shape[1]):
            total = out[j, i] * 0
            for x in range(i * k, (i + 1) * k):
                total += complex(re[x], im[x]) * np.conj(hx[x])
            out[j, i] += total


@njit(nogil=True, cache=True, fastmath=True)
def spread(spectrum: Any, field: Any, passed: Any, wy: Any, wx: Any, start: int, stop: int) -> None:
    """Repeat a periodic spectrum over a wider band, the axis in the middle, and weigh it.

    ``passed`` holds the weights of one quadrant, ``wy`` and ``wx`` those of all rows and columns.
    """
    period, band = len(spectrum), len(wy)
    half = band // 2
    for i in range(start, stop):
        row, down = (i - half) % period, abs(i - half)
        for j in range(band):
            field[i, j] = spectrum[row, (j - half) % period] * (passed[down, abs(j - half)] * (wy[i] * wx[j]))


@njit(nogil=True, cache=True, fastmath=True)
def collect(spectrum: Any, field: Any, passed: Any, wy: Any, wx: Any, start: int, stop: int) -> None:
    """Adjoint of :func:`spread`, rows ``start`` to ``stop`` of the periodic spectrum."""
    period, band = len(spectrum), len(wy)
    half = band // 2
    spectrum[start:stop] = 0
    for row in range(start, stop):
        for i in range((row + half) % period, band, period):
            down = abs(i - half)
            for j in range(band):
                weight = passed[down, abs(j - half)] * (wy[i] * wx[j])
                spectrum[row, (j - half) % period] += field[i, j] * np.conj(weight)


@njit(nogil=True, cache=True)
def _cell(position: float, k: int) -> tuple[int, float]:
    """SLM pixel in which a mask cell at ``position`` (mask pixels) begins, and the part of it in there."""
    first = int(np.floor(position / k))
    return first, min((first + 1) * k - position, 1.0)


@njit(nogil=True, cache=True)
def _row(nodes: Any, y: int, height: int, row: Any) -> None:
    """Interpolate the nodes, which span the whole mask, to the centres of mask row ``y``: (columns, 2)."""
    v = (y + 0.5) / height * (nodes.shape[0] - 1)
    j = min(int(v), nodes.shape[0] - 2)
    v -= j
    for i in range(nodes.shape[1]):
        row[i, 0] = (1 - v) * nodes[j, i, 0] + v * nodes[j + 1, i, 0]
        row[i, 1] = (1 - v) * nodes[j, i, 1] + v * nodes[j + 1, i, 1]


@njit(nogil=True, cache=True)
def _place(row: Any, y: int, x: int, width: int) -> tuple[float, float]:
    """Where cell ``(y, x)`` lies on the SLM, from :func:`_row`, mask pixels."""
    u = (x + 0.5) / width * (row.shape[0] - 1)
    i = min(int(u), row.shape[0] - 2)
    u -= i
    return (
        y + row[i, 0] + u * (row[i + 1, 0] - row[i, 0]),
        x + row[i, 1] + u * (row[i + 1, 1] - row[i, 1]),
    )


@njit(nogil=True, cache=True)
def fill_displaced(
    field: Any, slm: Any, mask: Any, table: Any, hy: Any, hx: Any, nodes: Any, k: int, start: int, stop: int
) -> None:
    """As :func:`fill`, but cell ``(y, x)`` sees the SLM at ``(y + dy, x + dx)``, weighted by area."""
    height, width = mask.shape
    row = np.empty((nodes.shape[1], 2))
    for y in range(start, stop):
        _row(nodes, y, height, row)
        for x in range(width):
            at_y, at_x = _place(row, y, x, width)
            j, in_j = _cell(at_y, k)
            i, in_i = _cell(at_x, k)
            value = table[0] * 0  # not of the field: what is in it may be no number
            for b in range(1 if in_j == 1 else 2):
                wy = 1 - in_j if b else in_j
                for a in range(1 if in_i == 1 else 2):
                    wx = 1 - in_i if a else in_i
                    if 0 <= j + b < slm.shape[0] and 0 <= i + a < slm.shape[1]:
                        value += slm[j + b, i + a] * (wy * wx)
            field[y, x] = value * table[mask[y, x]] * hy[y] * hx[x]


@njit(nogil=True, cache=True)
def mean_power(nodes: Any, mask_shape: Any, slm_shape: Any, k: int) -> tuple[float, float]:
    """Mean light behind a displaced mask of random phases and of equal ones, relative to a mask in place.

    A cell that sees two SLM pixels averages their phases away; one beside the SLM sees nothing.
    """
    height, width = mask_shape
    row = np.empty((nodes.shape[1], 2))
    mixed = covered = 0.0
    for y in range(height):
        _row(nodes, y, height, row)
        for x in range(width):
            at_y, at_x = _place(row, y, x, width)
            j, in_j = _cell(at_y, k)
            i, in_i = _cell(at_x, k)
            total = 0.0
            for b in range(2):
                wy = 1 - in_j if b else in_j
                for a in range(2):
                    wx = 1 - in_i if a else in_i
                    if 0 <= j + b < slm_shape[0] and 0 <= i + a < slm_shape[1]:
                        mixed += (wy * wx) ** 2
                        total += wy * wx
            covered += total * total
    return mixed / (height * width), covered / (height * width)


@njit(nogil=True, cache=True)
def gather_displaced(
    out: Any, field: Any, mask: Any, table: Any, hy: Any, hx: Any, nodes: Any, k: int, start: int, stop: int
) -> None:
    """Adjoint of :func:`fill_displaced` for mask rows ``start`` to ``stop``, added to the whole ``out``."""
    height, width = mask.shape
    row = np.empty((nodes.shape[1], 2))
    for y in range(start, stop):
        _row(nodes, y, height, row)
        for x in range(width):
            at_y, at_x = _place(row, y, x, width)
            j, in_j = _cell(at_y, k)
            i, in_i = _cell(at_x, k)
            value = field[y, x] * np.conj(table[mask[y, x]] * hy[y] * hx[x])
            for b in range(1 if in_j == 1 else 2):
                wy = 1 - in_j if b else in_j
                for a in range(1 if in_i == 1 else 2):
                    wx = 1 - in_i if a else in_i
                    if 0 <= j + b < out.shape[0] and 0 <= i + a < out.shape[1]:
                        out[j + b, i + a] += value * (wy * wx)


@njit(nogil=True, cache=True)
def _response(at: float, response: Any) -> tuple[complex, complex]:
    """``r(at)``, linear between levels of a whole turn, and how it rises a radian."""
    steps = (len(response) - 1) / (2 * np.pi)
    i = min(max(int(at * steps), 0), len(response) - 2)
    rise = response[i + 1] - response[i]
    return response[i] + rise * (at * steps - i), rise * steps


@njit(nogil=True, cache=True)
def respond(phase: Any, response: Any, dc: Any, out: Any) -> None:
    """``out = mean(r(phase) exp(j phase)) + dc``, the mean over the phases of each sample."""
    n = phase.shape[0] // out.shape[0]
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            total = 0j
            for b in range(y * n, (y + 1) * n):
                for a in range(x * n, (x + 1) * n):
                    at = phase[b, a]
                    total += _response(at, response)[0] * complex(np.cos(at), np.sin(at))
            out[y, x] = total / (n * n) + dc


@njit(nogil=True, cache=True)
def respond_back(phase: Any, response: Any, light: Any, gradient: Any, out: Any) -> None:
    """Change of the loss with each phase, from the gradient by the field of :func:`respond`."""
    n = phase.shape[0] // gradient.shape[0]
    for y in range(phase.shape[0]):
        for x in range(phase.shape[1]):
            at = phase[y, x]
            r, rise = _response(at, response)
            turned = light[y // n, x // n] * (rise + 1j * r) * complex(np.cos(at), np.sin(at))
            g = gradient[y // n, x // n]
            out[y, x] = 2 * (g.real * turned.real + g.imag * turned.imag) / (n * n)


@njit(nogil=True, cache=True, fastmath=True)
def rows_to_spectrum(
    field: Any, pairs: Any, spectrum: Any, ey: Any, ex: Any, filled: int, scale: float, start: int, stop: int
) -> None:
    """Finish the field's transform along its rows and add the intensity's spectrum, cropped to the pass-band.

    ``field`` ends as the field in the image plane; ``pairs`` is its real view. Only its first ``filled``
    columns are read. ``spectrum`` (rows, kept columns) receives the row transform of ``|field|^2 ey ex``
    times ``scale``; its transform along the columns is still to do.
    """
    width = field.shape[1]
    kept = spectrum.shape[1]
    axis = np.array([1])
    intensity = np.empty((ROWS_AT_ONCE, width), ey.dtype)
    half = np.empty((ROWS_AT_ONCE, width // 2 + 1), field.dtype)
    for top in range(start, stop, ROWS_AT_ONCE):
        n = min(ROWS_AT_ONCE, stop - top)
        rows = field[top : top + n]
        rows[:, filled:] = 0
        c2c(rows, rows, axis, True, 1.0, 1)
        for y in range(n):
            gain = ey.dtype.type(ey[top + y] * scale)
            line, light = pairs[top + y], intensity[y]
            for x in range(width):
                re, im = line[2 * x], line[2 * x + 1]
                light[x] = (re * re + im * im) * gain * ex[x]
        r2c(intensity[:n], half[:n], axis, True, 1.0, 1)
        for y in range(n):
            for x in range(kept):
                spectrum[top + y, x] += half[y, x]


@njit(nogil=True, cache=True, fastmath=True)
def rows_from_spectrum(
    field: Any, pairs: Any, spectrum: Any, ey: Any, ex: Any, scale: float, start: int, stop: int
) -> None:
    """Multiply ``field`` by the real image whose row spectra are given, then transform back along rows.

    ``pairs`` is the field's real view.
    """
    width = field.shape[1]
    kept = spectrum.shape[1]
    axis = np.array([1])
    image = np.empty((ROWS_AT_ONCE, width), ey.dtype)
    half = np.empty((ROWS_AT_ONCE, width // 2 + 1), field.dtype)
    for top in range(start, stop, ROWS_AT_ONCE):
        n = min(ROWS_AT_ONCE, stop - top)
        for y in range(n):
            half[y, kept:] = 0
            for x in range(kept):
                half[y, x] = spectrum[top + y, x]
        c2r(half[:n], image[:n], axis, False, 1.0, 1)
        rows = field[top : top + n]
        for y in range(n):
            gain = ey.dtype.type(ey[top + y] * scale)
            line, weights = pairs[top + y], image[y]
            for x in range(width):
                weight = weights[x] * gain * ex[x]
                line[2 * x] *= weight
                line[2 * x + 1] *= weight
        c2c(rows, rows, axis, False, 1.0, 1)


@njit(nogil=True, cache=True)
def _butterworth(y: int, x: int, cutoff: float) -> float:
    """Low-pass at a lag (Kuo 2020, Eq. 7.18); everything passes where the cut-off is 0."""
    if cutoff == 0:
        return 1.0
    r = (y * y + x * x) / (cutoff * cutoff)
    return 1.0 / (1.0 + r * r * r * r * r)


@njit(nogil=True, cache=True)
def filtered_power(spectrum: Any, target: Any, cutoff: float, top: int, full: bool) -> float:
    """Power of the low-passed difference of the kept rows of ``spectrum`` to ``target``.

    ``target`` holds the kept rows: the first ``top``, then the last ones. The mirrored half of the spectrum
    counts too (``full``: the last column is the Nyquist column, which has no mirror image).
    """
    kept, columns_kept = target.shape
    rows = spectrum.shape[0]
    total = 0.0
    for i in range(kept):
        y = i if i < top else rows - kept + i
        lag = i if i < top else i - kept
        for x in range(columns_kept):
            value = (spectrum[y, x] - target[i, x]) * _butterworth(lag, x, cutoff)
            power = float(value.real) ** 2 + float(value.imag) ** 2
            total += power if x == 0 or (full and x == columns_kept - 1) else 2 * power
    return total


@njit(nogil=True, cache=True, fastmath=True)
def filter_twice(spectrum: Any, target: Any, cutoff: float, top: int, full: bool) -> float:
    """As :func:`filtered_power`, :func:`subtract_and_filter` and :func:`low_pass` one after the other."""
    kept, columns_kept = target.shape
    rows = spectrum.shape[0]
    spectrum[top : rows - kept + top] = 0
    one = spectrum.real.dtype.type(1.0)
    scale = one / (cutoff * cutoff)
    total = 0.0
    for i in range(kept):
        y = i if i < top else rows - kept + i
        lag = i if i < top else i - kept
        down, across, doubled = one * (lag * lag), one * 0, one * 0
        for x in range(columns_kept):
            r = (down + one * (x * x)) * scale
            passed = one / (one + r * r * r * r * r)
            value = (spectrum[y, x] - target[i, x]) * passed
            spectrum[y, x] = value * passed
            power = value.real * value.real + value.imag * value.imag
            doubled += power
            if x == 0 or (full and x == columns_kept - 1):
                across += power
        total += 2 * float(doubled) - float(across)
    return total


@njit(nogil=True, cache=True)
def subtract_and_filter(spectrum: Any, target: Any, cutoff: float, top: int) -> None:
    """Replace the kept rows of ``spectrum`` by their low-passed difference to ``target``, others by 0."""
    kept, columns_kept = target.shape
    rows = spectrum.shape[0]
    spectrum[top : rows - kept + top] = 0
    for i in range(kept):
        y = i if i < top else rows - kept + i
        lag = i if i < top else i - kept
        for x in range(columns_kept):
            spectrum[y, x] = (spectrum[y, x] - target[i, x]) * _butterworth(lag, x, cutoff)


@njit(nogil=True, cache=True)
def low_pass(spectrum: Any, kept: int, cutoff: float, top: int) -> None:
    """Multiply the kept rows of ``spectrum`` by the low-pass."""
    rows = spectrum.shape[0]
    for i in range(kept):
        y = i if i < top else rows - kept + i
        lag = i if i < top else i - kept
        for x in range(spectrum.shape[1]):
            spectrum[y, x] *= _butterworth(lag, x, cutoff)


@njit(nogil=True, cache=True)
def copy_kept(source: Any, target: Any, kept: int, columns_kept: int, top: int) -> None:
    """Copy the kept lags between half spectra of different sizes; all else in ``target`` becomes 0."""
    target[:] = 0
    target[:top, :columns_kept] = source[:top, :columns_kept]
    rest = kept - top
    for i in range(rest):
        y, z = target.shape[0] - rest + i, source.shape[0] - rest + i
        for x in range(columns_kept):
            target[y, x] = source[z, x]


@njit(nogil=True, cache=True)
def weigh(image: Any, weights: Any) -> Any:
    """Return the mean of ``(image weights)^2`` and replace ``image`` by ``image weights^2 / size``."""
    total = 0.0
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            weighted = image[y, x] * weights[y, x]
            total += float(weighted) * float(weighted)
            image[y, x] = weighted * weights[y, x] / image.size
    return total / float(image.size)


@njit(nogil=True, cache=True)
def add_shifted(total: Any, spectrum: Any, rows: Any, columns: Any, ramp_y: Any, ramp_x: Any) -> None:
    """``total[i, j] += spectrum[rows[i], columns[j]] * ramp_y[i] * ramp_x[j]``."""
    for i in range(total.shape[0]):
        weight, y = ramp_y[i], rows[i]
        for j in range(total.shape[1]):
            total[i, j] += spectrum[y, columns[j]] * (weight * ramp_x[j])
