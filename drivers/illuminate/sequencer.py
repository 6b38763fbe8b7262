"""Sequences that the array itself times, and its trigger lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from drivers.errors import DeviceError, DeviceNotOpenError, LimitError
from drivers.illuminate.protocol import parse_trigger_outputs
from drivers.led_array import OFF, LedPattern, Rgb

if TYPE_CHECKING:
    from drivers.illuminate.led_array import IlluminateLedArray

_LONGEST_MS = _MOST_REPEATS = _LONGEST_US = 65_535  # the firmware keeps them in 16 bits
MOST_PATTERNS = 1000
_MARGIN_S = 5.0


class Sequencer:
    """What an Illuminate array does without the host: one pattern after the other, with triggers.

    All patterns of a sequence have the same colour: the firmware stores which LEDs, not their levels.
    """

    def __init__(self, array: IlluminateLedArray) -> None:
        self._array = array
        self._stored: tuple[LedPattern, ...] = ()
        self._rgb: Rgb = (0, 0, 0)

    def load(self, patterns: Sequence[LedPattern]) -> None:
        """Store a sequence in the array; it stays until the next ``load`` or ``close``.

        Parameters
        ----------
        patterns : sequence of LedPattern
            Dark ones may be among them.

        Raises LimitError when a pattern is out of range, too long for the firmware, or of another colour than
        the rest.
        """
        array = self._array
        dialect = array.link.dialect if array.is_open else None
        if dialect is None:
            raise DeviceNotOpenError(array.name)
        if not 1 <= len(patterns) <= MOST_PATTERNS:
            raise LimitError(
                array.name, f"stores 1 to {MOST_PATTERNS} patterns, not {len(patterns)}.", "Split them."
            )
        commands: list[bytes] = []
        colors: set[Rgb] = set()
        for place, pattern in enumerate(patterns):
            array.check(pattern)
            lit = {led: rgb for led, rgb in pattern.levels if rgb != (0, 0, 0)}
            colors.update(lit.values())
            words = dialect.sequence_pattern(sorted(lit))
            if len(words) >= dialect.longest_line or len(lit) > dialect.most_arguments:
                raise LimitError(
                    array.name,
                    f"pattern {place} ({pattern.description}) has {len(lit)} LEDs, more than firmware "
                    f"{array.link.version} takes in one command of {dialect.longest_line} bytes.",
                    "Use fewer LEDs, or set_pattern for each; for firmware 2 see longest_line.",
                )
            commands.append(words)
        if len(colors) > 1:
            raise LimitError(
                array.name,
                f"a sequence has one colour, these patterns have {len(colors)}: {sorted(colors)}.",
                "Load one sequence for each colour.",
            )
        with array.commanding:
            self._stored = ()
            for words in dialect.prepare_sequence:
                array.link.command(words)
            array.link.command(b"ssl.%d" % len(patterns))
            for words in commands:
                array.link.command(words)
            self._stored = tuple(patterns)
            self._rgb = next(iter(colors), (0, 0, 0))
            array.remember("sequence", lambda: self.load(patterns))

    def holds(self, patterns: Sequence[LedPattern]) -> bool:
        """Whether the array has these patterns stored."""
        return self._stored == tuple(patterns)

    def forget(self) -> None:
        """Take it that the array holds no sequence."""
        self._stored = ()

    def run(
        self,
        interval_ms: int,
        repeats: int = 1,
        *,
        outputs: Sequence[int] = (),
        inputs: Sequence[int] = (),
        timeout_s: float | None = None,
    ) -> int:
        """Show the stored sequence and block until it has ended; the array is dark afterwards.

        Parameters
        ----------
        interval_ms : int
            How long each pattern is shown; 0 lets the triggers alone pace it (firmware 2).
        repeats : int
            How often the whole sequence is shown.
        outputs, inputs : sequence of int
            For each trigger line: 0 unused, n > 0 a pulse sent (or awaited) with each n-th pattern.
        timeout_s : float, optional
            For the whole run; needed when inputs are awaited.

        Returns
        -------
        int
            Patterns shown.

        Raises LimitError when an argument is out of range or the array has no such trigger line; StoppedError
        when ``off`` ended it; DeviceError when the firmware refuses (an interval shorter than its LEDs take)
        or ends it: no trigger came.
        """
        array = self._array
        geometry = array.geometry
        if not self._stored:
            raise DeviceError(array.name, "has no sequence to run.", "Load one first.")
        self._check_run(interval_ms, repeats, outputs, inputs)
        if any(inputs) and timeout_s is None:
            raise LimitError(array.name, "cannot know how long triggers take.", "Give timeout_s with inputs.")
        shown = len(self._stored) * repeats
        limit_s = timeout_s if timeout_s is not None else shown * interval_ms / 1e3 * 1.5 + _MARGIN_S
        padded_outputs = [*outputs, *[0] * geometry.outputs][: geometry.outputs]
        padded_inputs = [*inputs, *[0] * geometry.inputs][: geometry.inputs]
        lit = {led for pattern in self._stored for led, _ in pattern.levels}
        with array.commanding:
            array.set_color(array.scaled(self._rgb))
            array.showing(
                LedPattern(
                    f"sequence of {len(self._stored)} patterns",
                    tuple((led, self._rgb) for led in sorted(lit)),
                )
            )
            words = array.link.dialect.run(interval_ms, repeats, padded_outputs, padded_inputs)
            try:
                array.link.command(words, limit_s)
                array.link.command(b"x")
            except BaseException as error:
                array.darken_after(error)
                raise
            array.showing(OFF)
        return shown

    def trigger(self, output: int = 0) -> None:
        """Send one pulse on a trigger output."""
        self._check_line("output", output, self._array.geometry.outputs)
        with self._array.commanding:
            self._array.link.command(b"tr.%d" % output)

    def set_output(self, output: int, pulse_us: int, delay_us: int = 0) -> tuple[int, int]:
        """Set a trigger output's pulse width and the delay behind it; returns what the array has now.

        Raises LimitError when there is no such output, or a time is out of range (1, or 0, to 65535
        microseconds).
        """
        array = self._array
        self._check_line("output", output, array.geometry.outputs)
        for what, value, least in (("pulse", pulse_us, 1), ("delay", delay_us, 0)):
            if not isinstance(value, int) or not least <= value <= _LONGEST_US:
                raise LimitError(
                    array.name,
                    f"takes no {what} of {value} us.",
                    f"Whole microseconds, {least} to {_LONGEST_US}.",
                )

        def send() -> tuple[int, int]:
            array.link.command(b"trs.%d.%d.%d" % (output, pulse_us, delay_us))
            outputs = parse_trigger_outputs(array.link.command(b"trs"))
            if output not in outputs:
                raise DeviceError(array.name, f"does not list trigger output {output}.", "Open it again.")
            return outputs[output]

        with array.commanding:
            made = send()
            array.remember(f"trigger output {output}", send)
        return made

    def _check_run(
        self, interval_ms: int, repeats: int, outputs: Sequence[int], inputs: Sequence[int]
    ) -> None:
        array = self._array
        least = array.link.dialect.shortest_interval_ms
        if not isinstance(interval_ms, int) or not least <= interval_ms <= _LONGEST_MS:
            raise LimitError(
                array.name,
                f"takes no interval of {interval_ms} ms.",
                f"Whole milliseconds, {least} to {_LONGEST_MS}.",
            )
        if not 1 <= repeats <= _MOST_REPEATS:
            raise LimitError(array.name, f"cannot repeat {repeats} times.", f"1 to {_MOST_REPEATS}.")
        for kind, modes, lines in (
            ("output", outputs, array.geometry.outputs),
            ("input", inputs, array.geometry.inputs),
        ):
            for line, mode in enumerate(modes):
                self._check_line(kind, line, lines)
                if not 0 <= mode <= MOST_PATTERNS:
                    raise LimitError(
                        array.name, f"trigger {kind} {line} takes no mode {mode}.", f"0 to {MOST_PATTERNS}."
                    )

    def _check_line(self, kind: str, line: int, lines: int) -> None:
        if not 0 <= line < lines:
            raise LimitError(
                self._array.name, f"has no trigger {kind} {line}.", f"It has {lines}, counted from 0."
            )
