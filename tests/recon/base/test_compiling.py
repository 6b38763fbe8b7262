"""Who waits for a compilation is told of it, whatever thread it is in."""

from __future__ import annotations

import threading

import numba

from recon.base.compiling import being_compiled


def test_what_is_compiled_in_another_thread_has_a_name_meanwhile() -> None:
    being_compiled()  # from here on it is heard of, as is what others may still be compiling

    @numba.njit
    def _takes_a_while(x: float) -> float:
        return sum([(x + i) ** 0.5 for i in range(3)]) + (x if x > 0 else -x)

    thread = threading.Thread(target=_takes_a_while, args=(1.0,))
    thread.start()
    seen = set()
    while thread.is_alive():
        seen.add(being_compiled())
    assert "takes_a_while" in seen
    assert being_compiled() != "takes_a_while"
