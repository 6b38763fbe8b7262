"""One stage made of several controllers: x, y and z from one, pitch and yaw from another."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any, ClassVar, Self, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_serializer, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from drivers.common.stage_axes import check_target
from drivers.device import DeviceIdentity, DriverOptions, Setting, SharedPart
from drivers.errors import DeviceError, DeviceNotOpenError, DeviceTimeoutError, StoppedError
from drivers.registry.registry import driver_names, load_driver
from drivers.stage import Stage, StageAxis

_Answer = TypeVar("_Answer")
_NAME = "composite"
_STOP_AGAIN_S = 0.1
_ENDED_S = 2.0
"""More than a part that moves no longer may need to say how its move ended."""


class StagePart(BaseModel):
    """One part: its driver, and that driver's own keys."""

    model_config = ConfigDict(frozen=True, extra="allow")

    driver: str = Field(description="Driver of this part, as a [stage] of its own would name it.")
    _options: DriverOptions
    _stage: type[Stage]

    @classmethod
    def options_model(cls, table: object) -> type[DriverOptions] | None:
        """Return what checks the keys of a part beside its driver; None when its driver cannot be told."""
        name = table.get("driver") if isinstance(table, Mapping) else None
        try:
            return load_driver("stage", name).Options if isinstance(name, str) else None
        except DeviceError:
            return None

    @model_validator(mode="wrap")
    @classmethod
    def _by_its_driver(cls, table: Any, check: Callable[[Any], Self]) -> Self:
        part = check(table)
        part._stage = _stage_driver(part.driver)
        # As instrument.bench.config_file does: strict JSON, so that arrays may be tuples and text is no
        # number.
        part._options = part._stage.Options.model_validate_json(json.dumps(part.model_extra), strict=True)
        return part

    @model_serializer
    def _with_defaults(self) -> dict[str, Any]:
        return {"driver": self.driver, **self._options.model_dump(mode="json")}

    def make(self) -> Stage:
        """Return the part, closed."""
        return self._stage(self._options)

    def claims(self) -> tuple[str, ...]:
        """Return what only one program may hold for this part."""
        return self._stage.claims(self._options)

    def axis_names(self) -> Iterable[str]:
        """Return the axes that the part's table names, as far as it does."""
        axes = getattr(self._options, "axes", ())
        return axes if isinstance(axes, Mapping) else ()


class CompositeOptions(DriverOptions):
    """Several stages as one."""

    parts: dict[str, StagePart] = Field(
        min_length=1,
        description="[stage.parts.NAME]: each as a [stage] of its own would be; homed in this order.",
    )

    @model_validator(mode="after")
    def _parts_differ(self) -> Self:
        claims: dict[str, str] = {}
        axes: dict[str, str] = {}
        for name, part in self.parts.items():
            for claim in part.claims():
                if (other := claims.setdefault(claim, name)) != name:
                    raise ValueError(
                        f"parts {other} and {name} both use {claim}; one of them can have all axes"
                    )
            for axis in part.axis_names():
                if (other := axes.setdefault(axis, name)) != name:
                    raise ValueError(f"parts {other} and {name} both have an axis {axis}")
        return self


class CompositeStage(Stage):
    """Several stages that are used as one: moved together, limited, stopped and made safe together.

    A target is checked against every part before any moves. When one part fails, the others are stopped.
    Homing goes from part to part in the order of ``bench.toml``.
    """

    Options: ClassVar[type[DriverOptions]] = CompositeOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        self.options = options = CompositeOptions.of(options)
        self._parts = {name: part.make() for name, part in options.parts.items()}
        self._opened = False
        self._moving: tuple[str, ...] = ()
        self._commanding = threading.RLock()
        self._counting = threading.Lock()
        self._stops = 0
        self._homing_in: int | None = None
        """The thread that homes."""
        self._home_over = threading.Event()

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim what every part claims."""
        return tuple(claim for part in CompositeOptions.of(options).parts.values() for claim in part.claims())

    # Device ----------------------------------------------------------------------------------------
    @property
    def name(self) -> str:
        """The stage as error messages name it; a part's error names the part."""
        return f"stage ({_NAME} of {', '.join(self.options.parts)})"

    def open(self) -> None:
        """Open every part, those that were lost too; when one fails, the others stay as they were.

        A part that is connected thus keeps its reference while another has yet to be plugged in again.
        """
        try:
            for name, part in self._parts.items():
                with _naming(name):
                    part.open()
        except BaseException as error:
            if not self._opened:
                self._close_after(error)
            raise
        try:
            self._refuse_double_axes()
        except DeviceError as error:
            self._opened = False
            self._close_after(error)
            raise
        self._opened = True

    def _refuse_double_axes(self) -> None:
        owners: dict[str, str] = {}
        for name, part in self._parts.items():
            for axis in part.axes:
                if (other := owners.setdefault(axis.name, name)) != name:
                    raise DeviceError(
                        self.name,
                        f"parts {other} and {name} both have an axis {axis.name}.",
                        "Name the axes of each part in bench.toml.",
                    )

    def close(self) -> None:
        """Close every part, each even if another fails."""
        if self._opened:
            self._opened = False
            self._close_parts()

    def _close_parts(self) -> None:
        self._all_at_once({name: part.close for name, part in self._parts.items()})

    def _close_after(self, error: BaseException) -> None:
        """Close all parts because the stage cannot be opened; that this fails too becomes a note."""
        try:
            self._close_parts()
        except DeviceError as another:
            error.add_note(f"Nor could all parts be closed: {another}")

    @property
    def is_open(self) -> bool:
        """Whether any part is connected, so that the others are stopped when one was lost."""
        return self._opened and any(part.is_open for part in self._parts.values())

    @property
    def identity(self) -> DeviceIdentity:
        """Who the parts say they are, joined."""
        self._require()
        found = [identity for _, identity in self._asked(lambda part: part.identity)]
        return DeviceIdentity(
            kind="stage",
            driver=_NAME,
            vendor=" + ".join(dict.fromkeys(identity.vendor for identity in found)),
            model=" + ".join(identity.model for identity in found),
            serial_number=" + ".join(identity.serial_number or "none" for identity in found),
            firmware=" + ".join(identity.firmware for identity in found),
            simulated=any(identity.simulated for identity in found),
        )

    def settings(self) -> Mapping[str, Setting]:
        """Read the settings of every part, each under the part's name."""
        self._require()
        return {
            f"{name}.{key}": value
            for name, settings in self._asked(lambda part: part.settings())
            for key, value in settings.items()
        }

    # Stage -----------------------------------------------------------------------------------------
    @property
    def axes(self) -> tuple[StageAxis, ...]:
        """The axes of all parts."""
        return tuple(axis for part in self._parts.values() for axis in part.axes)

    def position(self) -> dict[str, float]:
        """Ask every part where it is."""
        self._require()
        places = self._asked(lambda part: part.position())
        return {axis: place for _, part in places for axis, place in part.items()}

    def commanded_position(self) -> dict[str, float]:
        """Return the last target asked for."""
        self._require()
        places = self._asked(lambda part: part.commanded_position())
        return {axis: place for _, part in places for axis, place in part.items()}

    @property
    def is_homed(self) -> bool:
        """Whether every part is homed."""
        self._require()
        return all(homed for _, homed in self._asked(lambda part: part.is_homed))

    @property
    def is_moving(self) -> bool:
        """Whether any part moves."""
        self._require()
        return any(moving for _, moving in self._asked(lambda part: part.is_moving))

    @property
    def needs_unlocking(self) -> bool:
        """Whether an alarm holds any part that only ``unlock`` ends."""
        return any(part.needs_unlocking for part in self._parts.values())

    def unlock(self) -> None:
        """Unlock the parts that need it, each even if another fails; the others keep their positions.

        Raises DeviceError where none needs it.
        """
        self._require()
        locked = {name: part.unlock for name, part in self._parts.items() if part.needs_unlocking}
        if not locked:
            super().unlock()
        self._all_at_once(locked)

    def home(self) -> None:
        """Home part after part, in the order of ``bench.toml``; blocks until done."""
        self._require()
        stops = self._stops
        self._home_over.clear()
        self._homing_in = threading.get_ident()
        try:
            for name, part in self._parts.items():
                if self._stops != stops:
                    raise StoppedError(self.name, "homing was stopped.", "Home again before the next move.")
                with _naming(name):
                    part.home()
        finally:
            self._homing_in = None
            self._home_over.set()

    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        """Move the named axes to absolute positions, all parts at once; see the interface."""
        self._require()
        stops = self._stops
        with self._commanding:
            check_target(self.name, self.axes, target, self.is_homed)
            shares = {
                name: {axis.name: target[axis.name] for axis in part.axes if axis.name in target}
                for name, part in self._parts.items()
            }
            moved = [name for name, share in shares.items() if share]
            before = [name for name in self._moving if name not in moved and self._moves(name)]
            self._moving = (*before, *moved)
            try:
                for name in moved:
                    if self._stops == stops:
                        with _naming(name):
                            self._parts[name].move_to(shares[name], wait=False)
            except DeviceError as error:
                self._stop_after(error, self._moving)
                raise
            if self._stops != stops:
                self._stop_parts(self._moving)
                raise StoppedError(self.name, "the move was stopped.", "Check the position before going on.")
        if wait:
            self._follow(None, stops)
        return self.position()

    def wait(self, timeout_s: float | None = None) -> None:
        """Block until a running move has ended; when one part fails, the others are stopped."""
        self._require()
        self._follow(timeout_s, self._stops)

    def _follow(self, timeout_s: float | None, stops: int) -> None:
        """Wait for the parts that move; ``stops`` is the count of STOP from before they began."""
        moving = self._moving
        if not moving:
            return
        began_s = time.monotonic()
        late: DeviceTimeoutError | None = None
        with ThreadPoolExecutor(len(moving)) as pool:
            waits: dict[Future[None], str] = {
                pool.submit(self._wait_for, name, timeout_s): name for name in moving
            }
            try:
                for done in as_completed(waits):
                    error = done.exception()
                    over = timeout_s is not None and time.monotonic() - began_s >= timeout_s
                    if isinstance(error, DeviceTimeoutError) and over:  # the caller waits no longer
                        if self._moves(waits[done]):
                            late = error
                        else:  # it has ended meanwhile: where it should, or it says so
                            self._wait_for(waits[done], _ENDED_S)
                    elif error is not None:
                        raise error
            except BaseException as error:  # Ctrl-C too: the threads end when their parts have stopped
                if self._stops == stops:  # else all were stopped
                    self._stop_after(error, [name for wait, name in waits.items() if not wait.done()])
                raise
        if late is not None:
            raise late

    def stop(self) -> None:
        """Stop every part at once, each even if another fails."""
        self._require()
        with self._counting:
            self._stops += 1  # whoever is about to move or home another part sees it
        self._stop_parts(self._parts)
        if self._homing_in not in (None, threading.get_ident()):
            while not self._home_over.wait(_STOP_AGAIN_S):  # a part may only just have begun to home
                self._stop_parts(self._parts)

    def settles_within(self, axis: StageAxis) -> float:
        """Return how far from its target an axis may come to rest: what its part says."""
        return next(part.settles_within(axis) for part in self._parts.values() if axis in part.axes)

    def move_duration_s(self, start: Mapping[str, float], target: Mapping[str, float]) -> float:
        """Estimated seconds for a move; the parts move together, so the slowest counts."""
        durations = []
        for part in self._parts.values():
            names = {axis.name for axis in part.axes}
            durations.append(part.move_duration_s(start, {n: p for n, p in target.items() if n in names}))
        return max(durations, default=0.0)

    # Inside ----------------------------------------------------------------------------------------
    def _require(self) -> None:
        if not self._opened:
            raise DeviceNotOpenError(self.name)

    def _asked(self, ask: Callable[[Stage], _Answer]) -> Iterator[tuple[str, _Answer]]:
        """Ask part after part, each when its answer is wanted."""
        for name, part in self._parts.items():
            with _naming(name):
                answer = ask(part)
            yield name, answer

    def _moves(self, name: str) -> bool:
        with _naming(name):
            return self._parts[name].is_moving

    def _wait_for(self, name: str, timeout_s: float | None) -> None:
        with _naming(name):
            self._parts[name].wait(timeout_s)

    def _stop_parts(self, names: Iterable[str]) -> None:
        self._all_at_once({name: self._parts[name].stop for name in names})

    def _stop_after(self, error: BaseException, names: Iterable[str]) -> None:
        """Stop parts because another failed; that this fails too becomes a note."""
        try:
            self._stop_parts(names)
        except DeviceError as another:
            error.add_note(f"Nor could the other parts be stopped: {another}")

    def _all_at_once(self, steps: Mapping[str, Callable[[], None]]) -> None:
        """Do something to several parts, none waiting for another; raise the first error with all others."""
        if not steps:
            return

        def take(name: str) -> None:
            with _naming(name):
                steps[name]()

        with ThreadPoolExecutor(len(steps)) as pool:
            futures = [pool.submit(take, name) for name in steps]
        errors = [error for future in futures if (error := future.exception()) is not None]
        if errors:
            for another in errors[1:]:
                errors[0].add_note(f"And: {another}")
            raise errors[0]


@contextmanager
def _naming(part: str) -> Iterator[None]:
    """Let an error of a part say which part of the stage it is of."""
    try:
        yield
    except DeviceError as error:
        error.name_part(part)
        raise


def _stage_driver(name: str) -> type[Stage]:
    """Return the driver of a part.

    Raises ValidationError: at the key ``driver``, when there is no such driver or it cannot be a part.
    """
    names = [known for known in driver_names("stage") if known != _NAME]
    if name not in names:
        raise _at_driver(name, f"must be one of {', '.join(names)}")
    try:
        driver = load_driver("stage", name)
    except DeviceError as error:
        raise _at_driver(name, f"{error.problem} {error.remedy}") from error
    if driver.Shared is not None:
        raise _at_driver(name, f"must be a driver that does not share [{driver.Shared.table}] with the bench")
    return cast("type[Stage]", driver)


def _at_driver(name: str, text: str) -> ValidationError:
    mistake = PydanticCustomError("driver", "{text}", {"text": text})
    return ValidationError.from_exception_data(
        "part", [InitErrorDetails(type=mistake, loc=("driver",), input=name)]
    )
