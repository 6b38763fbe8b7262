"""Feed damaged files to the readers: ``python -m tests.fuzz READER --seconds N`` (or ``all`` of them).

Every input is the sound file, or one that broke something before, with bytes flipped, cut, repeated, moved,
or replaced by what is hard to read: brackets without end, huge numbers, NaN, zeros. Of JSON half are sound as
text, with a value that is another, of another kind, or gone. A reader passes when it
returns, or raises a known mistake in words, within two seconds and 500 MB. What fails is kept in
``tests/fuzz/corpus/READER`` (with ``--keep``) and is read again by tests/fuzz/test_readers.py.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import hashlib
import json
import logging
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from instrument.files.errors import in_words
from tests.fuzz.readers import READERS, Reader

CORPUS = Path(__file__).parent / "corpus"
_OURS = tuple(f"{Path(__file__).parents[2] / room}/" for room in ("instrument", "recon", "drivers", "tests"))
MOST_SECONDS = 2.0
MOST_BYTES = 500 << 20
TOKENS = (
    b"[" * 6000, b'{"a":' * 6000, b"1e999", b"-1", b"0", b"99999999999999999999", b"NaN", b"null", b"true",
    b'""', b"[]", b"{}", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\0", b"\n", b'"', b"\xc3(",
    b"1000000000", b'"a"', b"0.5",
)  # fmt: skip


class TooSlowError(BaseException):
    """A reader takes longer than it may; no ``except Exception`` hides it."""


VALUES = (
    None, True, False, 0, -1, 1, 2, 0.5, 1e308, -1e308, float("nan"), float("inf"), 10**20, 10**400, "",
    "a", "nan", "../..", "\0", [], [0], [None], ["a"], [[1.0]], {}, {"a": 1}, {"path": 3},
)  # fmt: skip


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return damaged bytes."""
    if data[:1] == b"{" and rng.random() < 0.5 and (text := _of_another_kind(data, rng)):
        return text
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        place = rng.randrange(len(changed) + 1)
        other = rng.randrange(len(changed) + 1)
        low, high = min(place, other), max(place, other)
        match rng.randrange(8):
            case 0 if changed:
                changed[place % len(changed)] ^= 1 << rng.randrange(8)
            case 1 if changed:
                changed[place % len(changed)] = rng.randrange(256)
            case 2:
                del changed[place:]
            case 3:
                del changed[place : place + rng.randrange(1, 40)]
            case 4:
                changed[place:place] = rng.choice(TOKENS)
            case 5:
                changed[place:place] = changed[low : min(high, low + 200)]
            case 6:
                token = rng.choice(TOKENS)
                changed[place : place + len(token)] = token
            case _:
                _replace_number(changed, rng)
    return bytes(changed)


def _of_another_kind(data: bytes, rng: random.Random) -> bytes:
    """Return JSON, or a line of it, with one to three values put in others' places or left out."""
    lines = data.splitlines() if data.count(b"\n{") else [data]
    line = rng.randrange(len(lines))
    try:
        whole = [json.loads(lines[line])]
    except (ValueError, RecursionError):
        return b""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places: list[tuple[Any, Any]] = []
        left: list[Any] = [whole]
        while left:
            inside = left.pop()
            keys = list(inside) if isinstance(inside, dict) else range(len(inside))
            places += [(inside, key) for key in keys]
            left += [inside[key] for key in keys if isinstance(inside[key], dict | list)]
        inside, key = rng.choice(places)
        other = rng.choice(places)
        if rng.random() < 0.1 and inside is not whole:
            del inside[key]
        else:
            inside[key] = copy.deepcopy(rng.choice((*VALUES, other[0][other[1]])))
    lines[line] = json.dumps(whole[0]).encode()
    return b"\n".join(lines)


def _replace_number(data: bytearray, rng: random.Random) -> None:
    """Put something else in the place of a number in text."""
    starts = [i for i in range(len(data)) if 48 <= data[i] <= 57 and (i == 0 or not 48 <= data[i - 1] <= 57)]
    if starts:
        start = rng.choice(starts)
        end = start
        while end < len(data) and 48 <= data[end] <= 57:
            end += 1
        data[start:end] = rng.choice(TOKENS)


def trouble(reader: Reader, path: Path) -> str:
    """Read; return what is wrong with how the reader took it, empty where nothing is."""
    began_s = time.process_time()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS + 1, MOST_SECONDS + 1)  # again: a reader may begin anew
    try:
        reader.read(path)
    except TooSlowError as error:
        return f"takes too long: {time.process_time() - began_s:.1f} s of the processor, at {error}"
    except RecursionError as error:
        return f"RecursionError: {error}"
    except Exception as error:  # noqa: BLE001 - that is what is looked for
        if in_words(error) is None:
            return f"{type(error).__name__}: {error}"[:300]
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    if time.process_time() - began_s > MOST_SECONDS:
        return f"takes {time.process_time() - began_s:.1f} s of the processor"
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10
    return f"takes {grown >> 20} MB" if grown > MOST_BYTES else ""


def inputs(sound: bytes, kept: list[bytes], rng: random.Random) -> Iterator[bytes]:
    """Give what broke something before, then damaged files without end."""
    yield from kept
    while True:
        yield mutated(rng.choice([sound, sound, sound, *kept]), rng)


def fuzz(name: str, *, seconds: float, runs: int, seed: int, keep: bool) -> tuple[int, dict[str, bytes]]:
    """Feed one reader; returns how many inputs it took, and one input for each way that it failed."""
    reader, rng, found, count = READERS[name], random.Random(seed), {}, 0
    signal.signal(signal.SIGPROF, _too_slow)
    kept = [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        made = reader.make(Path(folder))
        with contextlib.suppress(Exception):  # a reader for pictures and stacks may refuse one of the two
            reader.read(made)  # what is imported by the first is no input's time
        ends = time.monotonic() + seconds
        streams = []
        for end in reader.spoil:
            file = made.parent / end[3:] if end.startswith("../") else made / end if end else made
            sound = file.read_bytes()
            streams.append((file, sound, inputs(sound, kept, rng)))
        while count < runs and time.monotonic() < ends:
            file, sound, stream = streams[count % len(streams)]
            data = next(stream)
            file.write_bytes(data)
            count += 1
            problem = trouble(reader, made)
            file.write_bytes(sound)
            if problem and problem.split(":")[0] not in {known.split(":")[0] for known in found}:
                found[problem] = data
                if keep:
                    (CORPUS / name).mkdir(parents=True, exist_ok=True)
                    (CORPUS / name / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
    return count, found


def _too_slow(_number: int, frame: FrameType | None) -> None:
    """End a reader, and say where in this program it was."""
    inside = frame
    while inside is not None and not inside.f_code.co_filename.startswith(_OURS):
        inside = inside.f_back
    inside = inside or frame
    raise TooSlowError("" if inside is None else f"{Path(inside.f_code.co_filename).name}:{inside.f_lineno}")


def main() -> int:
    """Fuzz as the command line says; exit status 1 when something broke."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("reader", choices=[*READERS, "all"])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each reader")
    parser.add_argument("--runs", type=int, default=sys.maxsize, help="inputs of each reader, at most")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="keep what broke something in the corpus")
    options = parser.parse_args()
    logging.disable()
    warnings.simplefilter("ignore")
    total, broken = 0, 0
    for name in READERS if options.reader == "all" else [options.reader]:
        count, found = fuzz(
            name, seconds=options.seconds, runs=options.runs, seed=options.seed, keep=options.keep
        )
        total, broken = total + count, broken + len(found)
        print(f"{name}: {count} inputs, {len(found)} ways to break it", flush=True)
        for problem in found:
            print(f"  {problem}")
    print(f"{total} inputs in all, {broken} ways to break a reader")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
