"""Folders of images: in which order they are taken, and at which depths they say that they were."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

from instrument.files import reading
from instrument.files.errors import FileError

SUFFIXES = {".tif", ".tiff", ".png", ".bmp", ".npy", ".jpg", ".jpeg"}
_NUMBER, _COUNT = re.compile(r"\d+(?:\.\d+)?"), re.compile(r"\d+")
_DEPTH = re.compile(
    r"(?<!\de)(?<!\de[-+])(?<!\d)(?:(?<=[a-zA-Z_=])-)?"
    r"(?:\d+(?:\.\d+)?|(?<![\d.,p])\d+[,p]\d{1,2})(?= ?_?(nm|um|µm|μm|mm|cm)(?![a-zA-Z]))"
)
"""A length in a name; 1.5, 1,5 and 1p5 are the same. Three digits behind a comma or p are another number."""
_UM = {"nm": 1e-3, "um": 1.0, "µm": 1.0, "μm": 1.0, "mm": 1e3, "cm": 1e4}
MICRO_MANAGER = "metadata.txt"
_MICRO_MANAGERS = (
    re.compile(r"img_channel(?P<channel>.+)_position(?P<position>.+)_time(?P<time>\d+)_z(?P<z>\d+)"),
    re.compile(r"img_(?P<time>\d+)_(?P<channel>.*)_(?P<z>\d+)"),
)
"""What Micro-Manager calls its images, versions 2.0 and 1.4."""


def images_in(folder: Path) -> list[Path]:
    """Return a folder's image files as people count: numbers by their value, 2 before 10.

    A dot within a number is a decimal point, unless names that are the same but for their numbers would be
    the same so, or end in a 0 that shorter ones lack: 1.1 and 1.10, 1.9 and 1.10 are counted.
    """
    found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    alike: dict[tuple[str, ...], list[str]] = {}
    for path in found:
        alike.setdefault(_parts(path.name, _NUMBER)[0], []).append(path.name)
    number = {name: _COUNT if _are_counted(names) else _NUMBER for names in alike.values() for name in names}
    plain = {_parts(path.name, number[path.name])[0] for path in found}
    return sorted(found, key=lambda path: _natural(path.name, plain, number[path.name]))


def _are_counted(names: Sequence[str]) -> bool:
    """Whether dots within numbers of names, which are the same but for these, are no decimal points."""
    if len({tuple(_parts(name, _NUMBER)[1]) for name in names}) < len(names):
        return True
    for column in zip(*(_NUMBER.findall(name) for name in names), strict=True):
        digits = [after for number in column if (after := number.partition(".")[2])]
        most = max(map(len, digits), default=0)
        if most > 1 and min(map(len, digits)) < most and any(len(d) == most and d[-1] == "0" for d in digits):
            return True
    return False


def in_order(folder: Path, paths: Sequence[Path]) -> tuple[list[Path], tuple[float, ...]]:
    """Return files in the order of their depths, and the depths in micrometres; none where none are told.

    Depths are what Micro-Manager's ``metadata.txt`` says, else the only length in each name (``z60.5mm``,
    ``psf_-50um``). Without them, and of a film of Micro-Manager's whose focus wanders, the order stays.

    Raises FileError where Micro-Manager's names tell that there are images along two axes.
    """
    if _only_axis(folder, paths) == "time":
        return list(paths), ()
    depths = _micro_managers(folder, paths)
    if None in depths or not depths:  # none, or of other files
        depths = [_depth(path.name) for path in paths]
    known = [depth for depth in depths if depth is not None]
    if len(known) < len(paths) or len(set(known)) < len(known):
        return list(paths), ()
    pairs = sorted(zip(known, range(len(paths)), strict=True))
    return [paths[number] for _, number in pairs], tuple(depth for depth, _ in pairs)


def _only_axis(folder: Path, paths: Sequence[Path]) -> str:
    """Return the axis along which Micro-Manager's names tell images apart; empty for other names.

    Raises FileError where they are told apart along two.
    """
    for pattern in _MICRO_MANAGERS:
        named = [found for path in paths if (found := pattern.fullmatch(path.stem))]
        if len(named) < len(paths):
            continue
        counts = {axis: len({found[axis] for found in named}) for axis in pattern.groupindex}
        several = [f"{count} ({axis})" for axis, count in counts.items() if count > 1]
        if len(several) > 1:
            raise FileError(
                folder,
                f"holds images in {' x '.join(several)}; one stack is expected.",
                "Copy those of one stack to a folder of their own, with metadata.txt where there is one.",
            )
        return next((axis for axis, count in counts.items() if count > 1), "")
    return ""


def order_in_words(paths: Sequence[Path], depths_um: Sequence[float]) -> str:
    """Say in which order files are taken, the first and the last ones by name."""
    names = [path.name for path in paths]
    shown = names if len(names) <= 6 else [*names[:3], "...", *names[-2:]]
    words = f"{len(names)} files in the order {', '.join(shown)}"
    if depths_um:
        words += f", by their depths, {depths_um[0] / 1e3:g} to {depths_um[-1] / 1e3:g} mm"
    return words


def _parts(name: str, number: re.Pattern[str]) -> tuple[tuple[str, ...], list[float]]:
    """Return the texts before, between and after a name's numbers, and the numbers."""
    texts = tuple(text.casefold() for text in number.split(name))
    return texts, [float(found) for found in number.findall(name)]


def _natural(
    name: str, plain: Container[tuple[str, ...]], number: re.Pattern[str]
) -> tuple[list[tuple[int, float, str]], str]:
    """Return what a name is sorted by.

    A dash before a number is a minus where another name, whose texts ``plain`` has, is the same but for it.
    """
    texts, numbers = _parts(name, number)
    for i, text in enumerate(texts[:-1]):
        without = (*texts[:i], text[:-1], *texts[i + 1 :])
        if text.endswith("-") and without in plain:
            texts, numbers[i] = without, -numbers[i]
    parts: list[tuple[int, float, str]] = []
    for text, value in zip(texts, numbers, strict=False):
        parts += [(1, 0.0, text), (0, value, "")]
    return [*parts, (1, 0.0, texts[-1])], name


def _depth(name: str) -> float | None:
    found = list(_DEPTH.finditer(name))
    if len(found) != 1:
        return None
    return float(found[0][0].replace(",", ".").replace("p", ".")) * _UM[found[0][1]]


def _micro_managers(folder: Path, paths: Sequence[Path]) -> list[float | None]:
    """Return the z positions that Micro-Manager noted for files, versions 1.4 and 2.0; empty without them."""
    file = folder / MICRO_MANAGER
    if not file.is_file():
        return []
    try:
        noted: Any = reading.parse_json(reading.read_bytes(file))
        frames = [entry for entry in noted.values() if isinstance(entry, dict) and "ZPositionUm" in entry]
        by_name = {str(entry["FileName"]).rpartition("/")[2]: float(entry["ZPositionUm"]) for entry in frames}
    except (OSError, ValueError, KeyError, AttributeError, TypeError, FileError):
        return []  # another program's file: the images are read all the same
    return [by_name.get(path.name) for path in paths]
