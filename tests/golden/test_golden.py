"""Results are what they were when recorded, to rounding; see ``record.py`` for changes that are intended."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.golden import adapter, help_texts, store
from tests.golden.cases import CASES

THREADS = int(os.environ.get("GOLDEN_THREADS", "1"))
"""Results do not depend on it; arrays as small as these are done soonest by one."""


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    with adapter.threads_used(THREADS):
        yield


CHECKED = ("defaults", "auto", "files")
"""Words of cases whose calibration is checked against decoys as well, which costs more than the results."""


@pytest.mark.parametrize("name", CASES)
def test_the_result_is_the_stored_one(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if not any(word in name for word in CHECKED):
        monkeypatch.setattr("recon.reconstruction.reconstruct.check_calibration", lambda *_, **__: None)
    kept = store.read(name)
    assert kept is not None, f"{name} is not recorded: python -m tests.golden.record {name}"
    apart = store.differences(CASES[name].make(), kept, CASES[name].tolerance)
    assert not apart, (
        f"{name}: {'; '.join(apart)}. If that is intended, say why in a decision record, and record it: "
        f"python -m tests.golden.record {name}"
    )


def test_nothing_is_stored_that_is_no_case() -> None:
    assert store.names() == set(CASES)
    assert {path.stem for path in store.FOLDER.glob("*.npz")} == set(CASES)


@pytest.mark.parametrize(
    "words", adapter.command_names(), ids=lambda words: " ".join(words) or "diffuserbench"
)
def test_the_help_is_the_stored_one(words: tuple[str, ...]) -> None:
    path = help_texts.path_of(words)
    assert path.exists(), "python -m tests.golden.record --help-texts"
    assert help_texts.text_of(words) == path.read_text(), "python -m tests.golden.record --help-texts"


def test_every_stored_help_is_of_a_command() -> None:
    assert set(help_texts.FOLDER.glob("*.txt")) == {help_texts.path_of(w) for w in adapter.command_names()}
