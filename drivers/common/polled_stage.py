"""A stage whose controller is asked where it is: everything that such stages share but the protocol."""

from __future__ import annotations

import logging
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.common.stage_axes import check_target
from drivers.device import DeviceIdentity, Setting
from drivers.errors import DeviceError, DeviceNotOpenError, DeviceTimeoutError, StoppedError
from drivers.stage import Stage, StageAxis

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StageState:
    """What a controller says at one time.

    ``position`` is by axis name, in the bench's units; ``moving`` is true while any axis moves or homes;
    ``homed`` when every axis knows its reference. ``faults`` are what axes report after which a move cannot
    have ended well, each in words that name the axis.
    """

    position: Mapping[str, float]
    moving: bool
    homed: bool
    faults: tuple[str, ...] = ()


class _Motion:
    """A move or a homing from its start until every axis rests; moves begun meanwhile join it."""

    def __init__(self, homing: bool) -> None:
        self.homing = homing
        self.target: dict[str, float] = {}
        self.ended = False
        self.stopped = False
        self.failed: DeviceError | None = None
        self.interrupted = threading.Event()
        """STOP was called; whether it came in time is known once ``decided`` is set."""
        self.decided = threading.Event()

    def fail(self, error: DeviceError) -> None:
        """End it by an error, which all who wait for it are told."""
        self.failed = error
        self.ended = True


class PolledStage(Stage):
    """Moves, waits, stops and checks; a subclass speaks the protocol.

    What it takes care of: targets are refused whole; STOP overtakes, also a move that is just being sent; a
    blocked axis, one that halts early and a controller that reports a fault end in an error, never in a
    position taken for the target; Ctrl-C stops what it no longer waits for; a lost connection closes the
    stage, and ``open`` brings it back.

    A subclass implements the methods that begin with an underscore. ``_state``, ``_start`` and
    ``_start_homing`` return at once. Faults that ``_state`` reports end moves and refuse new ones, but not
    the next homing; what lasts through it (some controllers keep faults until they move) is no fault then.
    A fault that is seen while a motion runs is the motion's, whoever asked: it is told to who waits for the
    motion, or refuses the next one.
    """

    faults_last = True
    """Whether the controller reports a fault as long as it lasts; False: once, to whoever asks first."""

    poll_s = 0.02
    """Between two questions whether a move has ended."""
    stuck_s = 10.0
    """An axis that claims to move and stays where it is for this long is blocked."""
    grace_s = 0.3
    """A controller may need this long until it says that it moves, or that it has settled."""
    stop_again_s = 1.0
    """Axes that still move this long after STOP are told once more: it may have been lost on the line."""
    stop_s = 5.0
    """Axes that still move this long after STOP are an error."""

    _axes: tuple[StageAxis, ...] = ()
    _identity: DeviceIdentity | None = None

    def __init__(self) -> None:
        self._commanding = threading.RLock()
        self._motion: _Motion | None = None
        self._stops = 0
        self._counting = threading.Lock()
        self._commanded: dict[str, float] = {}
        self._excused: frozenset[str] = frozenset()
        self._noticed: dict[str, None] = {}
        """Faults seen and not told: a motion's, or any of a controller that says them once."""
        self._looking = threading.RLock()

    # The protocol ----------------------------------------------------------------------------------
    @abstractmethod
    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        """Connect, apply the options, and return who the controller is and its axes."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Let go of the connection, whatever state it is in; never raises."""

    @property
    @abstractmethod
    def _is_connected(self) -> bool:
        """Whether the connection is there and has not failed."""

    @abstractmethod
    def _state(self) -> StageState:
        """Ask where the axes are and whether they move."""

    @abstractmethod
    def _start(self, target: Mapping[str, float]) -> None:
        """Begin a move to a target within the limits, every axis at once."""

    @abstractmethod
    def _start_homing(self) -> None:
        """Begin to look for the reference of every axis."""

    @abstractmethod
    def _halt(self) -> None:
        """Stop every axis, ahead of whatever waits to be sent; callable from any thread."""

    def _tolerance(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may come to rest, in its unit."""
        return 1.01 * axis.resolution

    def settles_within(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may come to rest, in its unit."""
        return max(super().settles_within(axis), self._tolerance(axis))

    # Device ----------------------------------------------------------------------------------------
    def open(self) -> None:
        """Connect and stop whatever moves; see the interface."""
        if self._identity is not None and self._is_connected:
            return
        if self._identity is not None:  # of several controllers, those that were not lost may be moving
            self._halt_what_is_left()
        self._disconnect()
        try:
            self._identity, self._axes = self._connect()
            self._motion = None
            self._excused = frozenset()
            state = self._state()
            if state.moving:
                self._halt()
                state = self._wait_for_rest()
            if state.faults:
                _log.warning("%s: %s", self.name, "; ".join(state.faults))
            self._commanded = dict(state.position)
            self._noticed.clear()
        except BaseException:
            self._identity = None
            self._disconnect()
            raise

    def close(self) -> None:
        """Stop whatever moves and disconnect; of a stage that was lost, what can still be reached."""
        if self._identity is None:
            return
        try:
            if self._is_connected:
                self.stop()
            else:
                self._halt_what_is_left()
        finally:
            self._identity = None
            self._disconnect()

    @property
    def is_open(self) -> bool:
        """Whether the stage is connected and was not lost."""
        return self._identity is not None and self._is_connected

    @property
    def identity(self) -> DeviceIdentity:
        """Who the controller says it is."""
        if self._identity is None:
            raise DeviceNotOpenError(self.name)
        return self._identity

    def settings(self) -> Mapping[str, Setting]:
        """Read position, limits and speeds."""
        state = self._ask()
        settings: dict[str, Setting] = {"homed": state.homed, "faults": state.faults}
        return settings | self._common_settings(state.position)

    # Stage -----------------------------------------------------------------------------------------
    @property
    def axes(self) -> tuple[StageAxis, ...]:
        """The stage's axes; known once it was opened."""
        return self._axes

    def position(self) -> dict[str, float]:
        """Ask the controller where it is."""
        return dict(self._ask().position)

    def commanded_position(self) -> dict[str, float]:
        """Return the last target asked for."""
        self._require()
        return dict(self._commanded)

    @property
    def is_homed(self) -> bool:
        """Whether positions refer to a known reference."""
        return self._ask().homed

    @property
    def is_moving(self) -> bool:
        """Whether any axis moves."""
        return self._ask().moving

    def home(self) -> None:
        """Find the reference of every axis; blocks until done."""
        self._require()
        stops = self._stops
        with self._commanding:
            faults = self._look().faults
            self._excused = frozenset(faults if self.faults_last else ())
            self._noticed.clear()
            motion = self._motion = _Motion(homing=True)
            self._launch(motion, self._start_homing, stops)
        self._follow(motion, None)

    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        """Move the named axes to absolute positions; see the interface."""
        self._require()
        stops = self._stops
        with self._commanding:
            state = self._look()
            self._raise_faults(state)
            motion = self._motion
            homing = state.moving and motion is not None and motion.homing
            check_target(self.name, self._axes, target, state.homed and not homing)
            if motion is None or motion.ended or not state.moving:
                motion = self._motion = _Motion(homing=False)
            motion.target.update(target)
            self._launch(motion, lambda: self._start(target), stops)
            self._commanded.update(target)
        if wait:
            self._follow(motion, None)
        return self.position()

    def wait(self, timeout_s: float | None = None) -> None:
        """Block until a running move has ended."""
        self._require()
        if self._motion is not None:
            self._follow(self._motion, timeout_s)

    def stop(self) -> None:
        """Stop every axis at once; returns when they rest."""
        self._require()
        with self._counting:
            self._stops += 1  # whoever is about to send a move sees it
        motion = self._motion
        if motion is not None and not motion.ended:
            motion.interrupted.set()
        try:
            self._halt()
        finally:
            with self._commanding:  # by now no move is being sent
                self._decide({motion, self._motion})

    # Inside ----------------------------------------------------------------------------------------
    def _require(self) -> None:
        if self._identity is None:
            raise DeviceNotOpenError(self.name)

    def _ask(self) -> StageState:
        self._require()
        return self._look()

    def _look(self) -> StageState:
        """Ask for the state, and note its faults; an excused one that has gone is excused no more."""
        with self._looking:
            state = self._state()
            self._excused &= frozenset(state.faults)
            if not self.faults_last or (self._motion is not None and not self._motion.ended):
                faults = (fault for fault in state.faults if fault not in self._excused)
                self._noticed.update(dict.fromkeys(faults))
            return state

    def _raise_faults(self, state: StageState) -> None:
        """Raise the faults that were noticed, and those of a state, but for the excused ones."""
        with self._looking:
            new = (fault for fault in state.faults if fault not in self._excused)
            faults = list(dict.fromkeys([*self._noticed, *new]))
            self._noticed.clear()
        if faults:
            raise DeviceError(self.name, f"{'; '.join(faults)}.", "Remove the cause, then home again.")

    def _launch(self, motion: _Motion, start: Callable[[], None], stops: int) -> None:
        """Begin a motion unless STOP was called since ``stops`` was read; whichever came first, it ends."""
        if self._stops == stops:
            try:
                start()
            except DeviceError as error:
                motion.ended = True
                self._halt_after(error)  # some axes may have begun
                raise
            except BaseException as error:  # Ctrl-C
                self._stop_after(error)
                raise
        if self._stops != stops:
            self._halt()
            raise self._stopped(motion.homing)

    def _follow(self, motion: _Motion, timeout_s: float | None) -> None:
        """Wait until a motion has ended, and say how; Ctrl-C ends it."""
        try:
            self._watch(motion, timeout_s)
        except DeviceError:
            raise
        except BaseException as error:  # nothing moves on that nobody waits for
            self._stop_after(error)
            raise

    def _watch(self, motion: _Motion, timeout_s: float | None) -> None:
        began_s = moved_s = time.monotonic()
        last: Mapping[str, float] = {}
        seen_moving, rested_s = False, None
        while not motion.ended:
            if motion.interrupted.is_set():
                if not motion.decided.wait(2 * self.stop_s):  # stop() itself was interrupted
                    motion.ended = motion.stopped = True
                break
            try:
                state = self._ask()
                self._raise_faults(state)
            except DeviceError as error:
                if motion.interrupted.is_set():
                    continue
                motion.fail(error)
                self._halt_after(error)
                raise
            now_s = time.monotonic()
            if state.moving:
                seen_moving, rested_s = True, None
                if state.position != last:
                    last, moved_s = state.position, now_s
                elif now_s - moved_s > self.stuck_s:
                    raise self._blocked(motion)
            else:
                rested_s = now_s if rested_s is None else rested_s
                if self._arrived(motion, state, seen_moving) or now_s - rested_s > self.grace_s:
                    if not motion.interrupted.is_set():
                        self._end(motion, state)
                    continue
            if timeout_s is not None and now_s - began_s >= timeout_s:
                raise DeviceTimeoutError(
                    self.name, f"still moves after {timeout_s:g} s.", "Wait longer or stop."
                )
            motion.interrupted.wait(self.poll_s)
        if motion.stopped:
            raise self._stopped(motion.homing)
        if (failed := motion.failed) is not None:  # whoever else waited was told
            raise DeviceError(failed.device, failed.problem, failed.remedy)

    def _arrived(self, motion: _Motion, state: StageState, seen_moving: bool) -> bool:
        if motion.homing:
            return seen_moving and state.homed
        return not self._strays(motion, state)

    def _strays(self, motion: _Motion, state: StageState) -> list[str]:
        """Return, in words, the axes that are not where the motion should have brought them."""
        return [
            f"{axis.name} is at {state.position[axis.name]:g}, not {motion.target[axis.name]:g}"
            for axis in self._axes
            if axis.name in motion.target
            and abs(state.position[axis.name] - motion.target[axis.name]) > self._tolerance(axis)
        ]

    def _end(self, motion: _Motion, state: StageState) -> None:
        """Note that the axes rest, and raise if it is not where they should."""
        wrong: DeviceError | None = None
        if motion.homing:
            self._commanded = dict(state.position)
            if not state.homed:
                wrong = DeviceError(
                    self.name, "ended its homing without a reference.", "Check its switches and home again."
                )
        elif strays := self._strays(motion, state):
            wrong = DeviceError(
                self.name,
                f"came to rest elsewhere: {'; '.join(strays)}.",
                "Is something in its way, or was it moved by hand (knob, joystick)? Check, then home again.",
            )
        motion.ended = wrong is None
        if wrong is not None:
            motion.fail(wrong)
            raise wrong

    def _decide(self, motions: set[_Motion | None]) -> None:
        """After STOP: wait until the axes rest, and settle which motions had arrived before."""
        rests = False
        try:
            state = self._wait_for_rest()
            rests = True
            self._commanded = dict(state.position)
        finally:
            for motion in motions:
                if motion is not None and not motion.ended:
                    motion.stopped = motion.homing or not rests or bool(self._strays(motion, state))
                    motion.ended = True
                if motion is not None:
                    motion.decided.set()

    def _wait_for_rest(self) -> StageState:
        told_s = time.monotonic()
        deadline_s = told_s + self.stop_s
        while True:
            try:
                state = self._look()
                if not state.moving:
                    return state
            except StoppedError:  # another STOP cancelled the question
                if not self._is_connected:
                    raise
            if time.monotonic() > deadline_s:
                raise DeviceTimeoutError(
                    self.name,
                    f"still moves {self.stop_s:g} s after it was told to stop.",
                    "Switch off its power.",
                )
            if time.monotonic() - told_s > self.stop_again_s:
                told_s = time.monotonic()
                self._halt()
            time.sleep(self.poll_s)

    def _halt_what_is_left(self) -> None:
        try:
            self._halt()
        except DeviceError as error:  # said when the connection was lost
            _log.info("%s: closed without a stop: %s", self.name, error)

    def _halt_after(self, error: DeviceError) -> None:
        """Stop every axis because one failed; that this fails too becomes a note."""
        try:
            self._halt()
        except DeviceError as another:
            error.add_note(f"Nor could it be told to stop: {another}")

    def _stop_after(self, error: BaseException) -> None:
        """Stop, and learn where the axes are; that this fails becomes a note."""
        try:
            self.stop()
        except DeviceError as another:
            error.add_note(f"Nor could it be stopped: {another}")

    def _blocked(self, motion: _Motion) -> DeviceTimeoutError:
        error = DeviceTimeoutError(
            self.name,
            f"says that it moves, but has stayed where it is for {self.stuck_s:g} s.",
            "Free it and home again.",
        )
        motion.fail(error)
        self._halt_after(error)
        return error

    def _stopped(self, homing: bool) -> StoppedError:
        if homing:
            return StoppedError(self.name, "homing was stopped.", "Home again before the next move.")
        return StoppedError(self.name, "the move was stopped.", "Check the position before going on.")
