"""Record golden results again: ``python -m tests.golden.record [CASE ...] [--help-texts]``.

Without names, all cases. A result that changes needs a decision record that names the case and the reason.
"""

from __future__ import annotations

import argparse
import time

from tests.golden import adapter, help_texts, store
from tests.golden.cases import CASES


def main() -> None:
    """Record what was asked for, and say what has changed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="CASE")
    parser.add_argument("--help-texts", action="store_true", help="record the help of every command, no case")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--check", action="store_true", help="only say what differs; write nothing")
    asked = parser.parse_args()
    unknown = set(asked.names) - set(CASES)
    if unknown:
        parser.error(f"no golden case {', '.join(sorted(unknown))}")
    if asked.help_texts:
        print("\n".join(help_texts.record()) or "every help text is as recorded")
        return
    changed = []
    with adapter.threads_used(asked.threads):
        for name in asked.names or CASES:
            began = time.process_time()
            try:
                result = CASES[name].make()
            except Exception as error:  # noqa: BLE001 - the others are still worth recording
                print(f"{name:<32}FAILED: {error!r}", flush=True)
                continue
            spent = time.process_time() - began
            kept = store.read(name)
            apart = [] if kept is None else store.differences(result, kept, CASES[name].tolerance)
            changed += [name] if apart else []
            words = "new" if kept is None else "CHANGED " + "; ".join(apart) if apart else "as stored"
            print(f"{name:<32}{spent:6.2f} s  {words}", flush=True)
            if not asked.check and (kept is None or apart):
                store.write(name, result)
    if not asked.names and not asked.check:
        for name in store.names() - set(CASES):
            store.forget(name)
            print(f"{name}: removed")
    if changed:
        print(
            f"\n{len(changed)} results are not what was stored: {', '.join(changed)}.\n"
            "A change that is intended needs a decision record (docs/decisions) that names these cases, what "
            "changed and why. One that is not intended is a mistake: restore the files and mend the code."
        )


if __name__ == "__main__":
    main()
