"""Unpacking against a slow reading of the standards, bit by bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.common.camera_settings import GainScale
from drivers.common.pixels import Packing, PixelFormat, compile_kernels, genicam_format, unpack
from drivers.common.unpacking import KERNELS


def _bits(value: int, n: int) -> list[int]:
    return [(value >> i) & 1 for i in range(n)]


def _bytes(bits: list[int]) -> bytes:
    bits = bits + [0] * (-len(bits) % 8)
    return bytes(sum(bit << i for i, bit in enumerate(bits[k : k + 8])) for k in range(0, len(bits), 8))


def _pack_line(pixels: list[int], packing: Packing) -> bytes:
    """Pack a line by the words of the standards, one pixel at a time."""
    if packing == "bytes":
        return bytes(pixels)
    if packing in ("words", "big words"):
        return b"".join(p.to_bytes(2, "little" if packing == "words" else "big") for p in pixels)
    kind, n_bits = packing.split()
    n = int(n_bits)
    if kind == "lsb":  # PFNC 2.0, figure "lsb packed": a stream of bits
        return _bytes([bit for p in pixels for bit in _bits(p, n)])
    per_group = 4 if (kind, n) == ("mipi", 10) else 2
    pixels = pixels + [0] * (-len(pixels) % per_group)
    packed = b""
    for k in range(0, len(pixels), per_group):
        group = pixels[k : k + per_group]
        low = n - 8
        high = [p >> low for p in group]
        lows = [p & ((1 << low) - 1) for p in group]
        if kind == "mipi":  # CSI-2, "RAW10" and "RAW12"
            packed += bytes(high) + _bytes([bit for part in lows for bit in _bits(part, low)])
        else:  # GigE Vision 1.2, table "Mono10Packed" and "Mono12Packed": low bits at bits 0 and 4
            packed += bytes([high[0], lows[0] | lows[1] << 4, high[1]])
    return packed


PACKINGS: dict[Packing, int] = {
    "bytes": 8,
    "words": 16,
    "big words": 16,
    "lsb 10": 10,
    "lsb 12": 12,
    "gige 10": 10,
    "gige 12": 12,
    "mipi 10": 10,
    "mipi 12": 12,
}


@st.composite
def images(draw: st.DrawFn) -> tuple[Packing, np.ndarray, int]:
    packing = draw(st.sampled_from(sorted(PACKINGS)))
    shape = draw(st.tuples(st.integers(1, 5), st.integers(1, 13)))
    top = (1 << PACKINGS[packing]) - 1
    dtype = np.uint8 if top < 256 else np.uint16
    return packing, draw(arrays(dtype, shape, elements=st.integers(0, top))), draw(st.integers(0, 5))


@settings(deadline=None)
@given(images())
def test_lines_with_padding_unpack_to_what_was_packed(case: tuple[Packing, np.ndarray, int]) -> None:
    packing, image, padding = case
    lines = [_pack_line([int(p) for p in row], packing) for row in image]
    group = PixelFormat("x", PACKINGS[packing], packing).line_bytes(image.shape[1])
    pitch = group + padding
    data = b"".join(line.ljust(pitch, b"\xff") for line in lines)
    out = np.empty_like(image)
    assert unpack(np.frombuffer(data, np.uint8), packing, out, pitch)
    np.testing.assert_array_equal(out, image)
    # The end of the last line need not be there; less than the image is refused.
    out[...] = 0
    needed = (len(lines) - 1) * pitch + len(lines[-1])
    assert unpack(np.frombuffer(data[:needed], np.uint8), packing, out, pitch)
    np.testing.assert_array_equal(out, image)
    assert not unpack(np.frombuffer(data[: needed - 1], np.uint8), packing, out, pitch)


@settings(deadline=None)
@given(images())
def test_lines_without_padding_unpack_to_what_was_packed(case: tuple[Packing, np.ndarray, int]) -> None:
    packing, image, tail = case
    data = _pack_line([int(p) for p in image.ravel()], packing)
    for sent in (data, data + b"\xff" * tail):
        out = np.empty_like(image)
        assert unpack(np.frombuffer(sent, np.uint8), packing, out)
        np.testing.assert_array_equal(out, image)
    assert not unpack(np.frombuffer(data[:-1], np.uint8), packing, out)


@settings(deadline=None)
@given(st.sampled_from(sorted(PACKINGS)), st.binary(max_size=64), st.integers(1, 6), st.integers(1, 6))
def test_arbitrary_bytes_are_unpacked_or_refused(
    packing: Packing, data: bytes, height: int, width: int
) -> None:
    out = np.zeros((height, width), np.uint8 if packing == "bytes" else np.uint16)
    for pitch in (None, 1, len(data)):
        if unpack(np.frombuffer(data, np.uint8), packing, out, pitch):
            assert out.max() < 1 << PACKINGS[packing]


def test_pixels_of_more_than_eight_bits_are_words() -> None:
    assert [PixelFormat("x", bits, "words").dtype for bits in (7, 8, 9)] == [np.uint8, np.uint8, np.uint16]


def test_what_is_packed_is_compiled_before_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    for packing in PACKINGS:
        monkeypatch.setitem(KERNELS, packing, lambda *_, packing=packing: compiled.append(packing))
        compile_kernels(packing)
    assert compiled == [packing for packing in PACKINGS if packing not in ("bytes", "words", "big words")]


def test_a_line_pitch_below_the_line_is_refused() -> None:
    assert not unpack(np.zeros(100, np.uint8), "bytes", np.zeros((4, 8), np.uint8), 7)


@pytest.mark.parametrize(
    ("name", "bits", "packing", "channels"),
    [
        ("Mono8", 8, "bytes", 1),
        ("Mono10", 10, "words", 1),
        ("Mono12p", 12, "lsb 12", 1),
        ("Mono10Packed", 10, "gige 10", 1),
        ("BayerRG12Packed", 12, "gige 12", 1),
        ("BayerGB10p", 10, "lsb 10", 1),
        ("Mono16", 16, "words", 1),
        ("RGB8", 8, "bytes", 3),
    ],
)
def test_genicam_names_are_understood(name: str, bits: int, packing: str, channels: int) -> None:
    found = genicam_format(name)
    assert found == PixelFormat(name, bits, packing, channels)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["YUV422_8", "Mono14p", "Mono16p", "BayerXX8", "Mono8s", ""])
def test_formats_that_cannot_be_unpacked_are_not_offered(name: str) -> None:
    assert genicam_format(name) is None


@pytest.mark.parametrize(
    ("scale", "number", "factor"),
    [
        (GainScale("dB", 0.1, 0), 60, 10**0.3),
        (GainScale("factor", 0.01, 1), 250, 2.5),
        (GainScale("steps", 0.1, 10), 15, 1.5),
    ],
)
def test_a_cameras_number_of_gain_is_a_factor(scale: GainScale, number: float, factor: float) -> None:
    assert scale.factor(number) == pytest.approx(factor)
    assert scale.number(factor) == pytest.approx(number)
