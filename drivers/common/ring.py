"""A fixed set of frame buffers, handed out and taken back without copying."""

from __future__ import annotations

import mmap
import weakref
from collections import deque

import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


class BufferPool:
    """``n_buffers`` preallocated images that are used again once nobody holds them.

    :meth:`take` gives an image over a free buffer. The buffer is free again when that image, and every
    array that was sliced or viewed from it, is gone: a consumer may keep an image as long as it likes and
    never sees it overwritten, it only keeps one buffer from the others.

    Parameters
    ----------
    n_buffers : int
    shape : tuple of int
        ``(height, width)`` or ``(height, width, 3)``.
    dtype
        uint8 or uint16.
    """

    def __init__(self, n_buffers: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._shape = shape
        self._dtype = np.dtype(dtype)
        n_bytes = int(np.prod(shape)) * self._dtype.itemsize
        self._memory = [mmap.mmap(-1, n_bytes) for _ in range(n_buffers)]
        for memory in self._memory:  # page faults now, not while streaming
            np.frombuffer(memory, np.uint8).fill(0)
        self._free: deque[int] = deque(range(n_buffers))

    @property
    def n_free(self) -> int:
        """Number of buffers that nobody holds."""
        return len(self._free)

    def take(self) -> Pixels | None:
        """Return a writeable image over a free buffer, or None when all are held."""
        try:
            number = self._free.popleft()
        except IndexError:
            return None
        # Arrays made from this one refer to it, and not to what lies under it, only because that is no array
        # (numpy's rule for a view's base). So its end is the end of everything that looks at the buffer.
        image: Pixels = np.ndarray(self._shape, self._dtype, buffer=self._memory[number])
        # Called in whatever thread lets go last, so it must not take a lock; append is atomic.
        weakref.finalize(image, self._free.append, number).atexit = False
        return image
