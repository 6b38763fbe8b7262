"""What the operator is asked to do by hand, and a job's wait for the answer."""

from __future__ import annotations

import threading
from collections.abc import Callable


class OperatorRequest:
    """Something that the operator is asked to do by hand; a job waits for the answer."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.answered: Callable[[], None] | None = None
        self.withdrawn: Callable[[], object] | None = None
        """Takes the question from the screen when STOP has answered it."""
        self._done = threading.Event()
        self._refused = False

    def confirm(self) -> None:
        """Say that it is done."""
        self._answer()

    def refuse(self) -> None:
        """Say that it will not be done: the job ends."""
        self._refused = True
        self._answer()

    @property
    def is_answered(self) -> bool:
        """Whether the operator (or STOP) has answered."""
        return self._done.is_set()

    def _answer(self) -> None:
        if not self._done.is_set():
            self._done.set()
            if self.answered is not None:
                self.answered()

    def wait(self) -> None:
        """Wait for the answer, in the job's thread; KeyboardInterrupt when it is no."""
        self._done.wait()
        if self._refused:
            raise KeyboardInterrupt
