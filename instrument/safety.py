"""Trying every step of making something safe, whatever happens to the others."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from instrument.errors import BenchError


class StepsFailedError(BenchError):
    """Some steps of making the bench safe failed; all were tried.

    Attributes
    ----------
    failures : tuple of (str, BaseException)
        Each failed step in words, with its error.
    """

    exit_code = 1

    def __init__(self, failures: Iterable[tuple[str, BaseException]]) -> None:
        self.failures = tuple(failures)
        listed = "".join(f"\n  {step}: {str(error) or type(error).__name__}" for step, error in self.failures)
        super().__init__(f"The bench may not be safe. Check by eye what could not be done:{listed}")


def try_all(steps: Iterable[tuple[str, Callable[[], None]]]) -> None:
    """Run every step in order, each even if those before it failed or were interrupted.

    Parameters
    ----------
    steps : iterable of (str, callable)
        The step in words, e.g. ``"light off, led_array (illuminate)"``, and what does it.

    Raises
    ------
    KeyboardInterrupt, SystemExit
        The first of them that came during a step, after every step was tried; failures are its notes.
    StepsFailedError
        When steps failed.
    """
    failures: list[tuple[str, BaseException]] = []
    interruption: BaseException | None = None
    for name, step in steps:
        try:
            step()
        except Exception as error:  # noqa: BLE001 - the next step must be tried whatever this one raised
            failures.append((name, error))
        except BaseException as error:  # noqa: BLE001 - an impatient Ctrl-C must not leave the light on
            failures.append((name, error))
            interruption = interruption or error
    if not failures:
        return
    failed = StepsFailedError(failures)
    if interruption is not None:
        interruption.add_note(str(failed))
        raise interruption
    raise failed
