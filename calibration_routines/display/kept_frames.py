"""Frames of routines whose next picture depends on the last one: kept as they come, and seen again.

A plan cannot tell such frames beforehand. They go into a run of their own, a recording whose log says of each
what it was asked for: what the SLM showed, exposure, light, place of the stage. A routine that is carried out
again with such a run asks the same questions and gets the frames that answered them; the first question
beyond them goes to the camera. So a routine that ended early goes on, and one that ended well is analysed
again. Meanwhile SLM and stage go where they went: what follows finds them as they were.
"""

from __future__ import annotations

import hashlib
import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from drivers.errors import StoppedError
from drivers.frame import FrameMetadata
from instrument.bench.bench import Bench
from instrument.files.atomic import SPARE_BYTES, free_bytes
from instrument.files.errors import BenchError, count, size
from instrument.runs.acquire import record_of
from instrument.runs.interrupts import interrupts_held
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_control import EndedEarlyError
from instrument.runs.run_files import BENCH_TOML
from instrument.runs.writer import FrameToStore, RunWriter
from recon.arrays import Array
from recon.base.declare import RARE, option
from recon.base.option_text import command_line

_ASKED = "asked"


class Taken(Protocol):
    """A frame, or a photograph."""

    @property
    def image(self) -> Array:
        """Its counts."""

    @property
    def metadata(self) -> FrameMetadata:
        """How it came about."""


@dataclass(frozen=True, kw_only=True)
class SeenAgain:
    """Options of a routine whose frames can be seen again."""

    again: Path | None = option(
        None,
        metavar="RUN",
        label="Frames of run",
        help="A run of the same: its frames are seen again, and further ones taken where they end.",
        default_words="new frames",
        group=RARE,
    )


class KeptFrames:
    """Keeps the frames of one routine on its bench; a context, which ends their run.

    Parameters
    ----------
    bench : Bench
        Open.
    folder : Path or None
        Where the run's folder goes; None: the bench's data folder.
    command : str
        That carries the routine out, ``"calibrate slm"``.
    options : SeenAgain
        Of the routine; in the run's log as they are typed. A run that they name is seen again, and new frames
        are added to it.

    Raises BenchError when that run holds no frames of this routine; RunError when it is no run.
    """

    def __init__(self, bench: Bench, folder: Path | None, command: str, options: SeenAgain) -> None:
        self._bench, self._folder, self._command = bench, folder, command
        self._typed, again = command_line(command, replace(options, again=None)), options.again
        self._run = None if again is None else Run.open(again)
        self._questions: list[str] = []
        self._writer: RunWriter | None = None
        self._next, self._complete = 0, False
        if self._run is not None:
            if (made := kept_by(self._run)) != command:
                what = f"is of {made}" if made else "holds no frames of such a routine"
                raise BenchError(f"{again} {what}; --again takes a run of {command}.")
            self._questions = _answered(self._run)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if error is not None and self.path is not None:
            number = max(self._next, len(self._questions))
            kept = f"{count(number, 'frame')} {'is' if number == 1 else 'are'} kept"
            what = "go on with them"
            if self._complete:
                kept, what = f"All {kept}", "see them again"
            error.add_note(f"{kept}. To {what}: {_typed_again(self._typed, self.path)}")
        if self._writer is not None and not self._complete:
            reason = FinishReason.COMPLETED
            if isinstance(error, EndedEarlyError):
                reason = error.reason
            elif isinstance(error, StoppedError):
                reason = FinishReason.STOPPED
            elif error is not None:
                reason = FinishReason.FAILED if isinstance(error, Exception) else FinishReason.ABORTED
            self._writer.finish(reason, "" if error is None else str(error) or type(error).__name__)

    def finish(self) -> None:
        """End the run: all frames are there, whatever becomes of what is computed from them."""
        self._complete = True
        if self._writer is not None:
            self._writer.finish(FinishReason.COMPLETED)

    @property
    def path(self) -> Path | None:
        """The run's folder; None before the first frame."""
        if self._writer is not None:
            return self._writer.path
        return None if self._run is None else self._run.path

    @property
    def paths(self) -> tuple[Path, ...]:
        """The same, as an outcome's runs."""
        return () if self.path is None else (self.path,)

    def answers(self, questions: Sequence[str], take: Callable[[int], Sequence[Taken]]) -> list[Array]:
        """Return the images that answer questions, one after the other.

        Parameters
        ----------
        questions : sequence of str
            What distinguishes each picture from others (:func:`question`).
        take : callable
            Takes the frames from the question of this number on, one or more, where they are not kept yet.

        Raises BenchError when a kept frame is of another question; RunError when the disk fails.
        """
        images: list[Array] = []
        while len(images) < len(questions):
            asked = questions[len(images)]
            if self._next < len(self._questions):
                images.append(self._again(asked))
                continue
            taken = take(len(images))
            self._keep(taken, questions[len(images) :])
            images += [frame.image for frame in taken]
        return images

    def _again(self, asked: str) -> Array:
        assert self._run is not None
        if self._questions[self._next] != asked:
            raise BenchError(
                f"{self._run.path}: its frame {self._next} is of another picture, exposure or place than is "
                "asked for now: other options, another bench, or another version of this program. Take new "
                "frames, without --again."
            )
        self._next += 1
        return np.asarray(self._run.frame(self._next - 1))

    def _keep(self, taken: Sequence[Taken], questions: Sequence[str]) -> None:
        if self._writer is None:
            if self._run is not None:
                self._writer = RunWriter.reopen(self._run.path)
            else:
                folder = self._folder or self._bench.config.data_folder
                label = self._command.split()[-1]
                self._writer = RunWriter.create(folder, label=label, bench=record_of(self._bench))
            self._writer.start(routine=self._command, typed=self._typed)
        frames = [FrameToStore(self._next + n, one.image, one.metadata) for n, one in enumerate(taken)]
        try:
            with interrupts_held() as held:  # all of a sequence are there, which may have taken minutes
                for frame, asked in zip(frames, questions, strict=False):
                    self._writer.note(_ASKED, index=frame.index, question=asked)
                self._writer.write(frames)
                self._next += len(frames)
        except Exception as error:
            held.answer(str(error))
            raise
        held.answer()


def kept_words(bench: Bench, frames: int, again: Path | None, folder: Path | None = None) -> str:
    """Return where frames go that are kept, and how large so many are at most.

    Raises BenchError where the disk of ``folder`` (None: the bench's data folder) has no room for them; of a
    run that is seen ``again`` no more is known than that further ones need some.
    """
    camera, folder = bench.camera, again or folder or bench.config.data_folder
    each = math.prod(camera.frame_shape) * camera.frame_dtype.itemsize
    need, free = 0 if again else frames * each, free_bytes(folder)
    if need + SPARE_BYTES > free:
        raise BenchError(
            f"{folder}: {count(frames, 'frame')} need {size(need)} and {size(SPARE_BYTES)} to spare, but "
            f"only {size(free)} are free on the disk. Free some, or choose another folder."
        )
    words = f"frames are kept, {size(frames * each)} at most"
    return words if again is None else f"{words}; those of {again} are seen again"


def question(shown: Array | None, *settings: Any) -> str:
    """Return what distinguishes a picture: a digest of what the SLM shows, and what else was set."""
    told = hashlib.blake2b(repr(settings).encode(), digest_size=16)
    if shown is not None:
        told.update(repr(shown.shape).encode() + np.ascontiguousarray(shown).tobytes())
    return told.hexdigest()


def kept_by(run: Run) -> str:
    """Return the command whose routine kept a run's frames so; empty for every other run."""
    return next((str(event["routine"]) for event in run.events if "routine" in event), "")


def going_on(run: Run) -> str:
    """Return what is typed to go on with a run's kept frames, on its own bench; empty for every other run."""
    if not (command := kept_by(run)):
        return ""
    typed = next(
        (str(event["typed"]) for event in run.events if "typed" in event), f"diffuserbench {command}"
    )
    return _typed_again(typed, run.path)


def _typed_again(typed: str, run: Path) -> str:
    """Return what is typed to have a run's frames seen again, on the bench that they were taken on."""
    return f"{typed} --again {shlex.quote(str(run))} --bench {shlex.quote(str(run / BENCH_TOML))}"


def _answered(run: Run) -> list[str]:
    """Return the questions of the frames that are there, up to the first that is not as it was written."""
    asked = {event["index"]: str(event["question"]) for event in run.events if event.get("kind") == _ASKED}
    questions: list[str] = []
    while (index := len(questions)) in asked and index in run.records and run.verify(index) is None:
        questions.append(asked[index])
    return questions
