"""Live pictures where there is no memory for a level, or making one fails."""

from __future__ import annotations

import pytest

from recon.streams.live_picture import Level
from tests.recon.live.streams import AMPLE_MS, iterated, live, photograph, taking


@pytest.fixture
def lacking(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """The binnings for whose solver there is no memory."""
    binnings: set[int] = set()

    solving = Level.solving

    def if_there_is_memory(level: Level) -> Level:
        if level.binning in binnings:
            raise MemoryError("none left")
        return solving(level)

    monkeypatch.setattr(Level, "solving", if_there_is_memory)
    return binnings


def test_a_coarser_binning_without_memory_is_told_once_and_pictures_go_on(lacking: set[int]) -> None:
    reconstructor = live(coarsest=4, budget_ms=100.0)
    iterated(reconstructor, photograph(0, 0))
    lacking.add(2)
    tried: list[int] = []
    picture = None
    while picture is None or picture.binning == 1:
        taking(reconstructor, fixed_ms=10, step_ms=60)
        picture = reconstructor.feed(photograph(0.5 * (len(tried) % 2), len(tried)))
        if reconstructor._coming is not None:
            tried.append(reconstructor._coming.detail.binning)
            reconstructor._coming.wait()
    assert tried == [2, 3]
    assert picture.binning == 3
    (told,) = reconstructor.warnings
    assert "no memory" in told
    assert "2 x 2" in told
    assert "go on binned 1 x 1" in told
    reconstructor.restart()
    assert reconstructor.warnings == ()
    assert 2 in reconstructor._pace.levels


def test_a_finer_binning_without_memory_is_not_tried_again(
    lacking: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    reconstructor = live(coarsest=4, budget_ms=AMPLE_MS)
    monkeypatch.setattr("recon.streams.live.AT_ONCE", 500)  # begins coarse
    lacking.add(1)
    assert iterated(reconstructor, photograph(0, 0)).binning == 4
    tried: list[int] = []
    for n in range(12):
        picture = reconstructor.feed(photograph(0.5 * (n % 2), n))
        if reconstructor._coming is not None:
            tried.append(reconstructor._coming.detail.binning)
            reconstructor._coming.wait()
    assert tried == [1]
    assert (picture.binning, picture.method) == (4, "admm-sensor")
    assert len(reconstructor.warnings) == 1


def test_without_memory_for_the_first_solver_a_coarser_one_is_made(lacking: set[int]) -> None:
    lacking.update((1, 2))
    reconstructor = live(coarsest=4, budget_ms=AMPLE_MS)
    for n in range(6):
        picture = reconstructor.feed(photograph(0, n))
        assert reconstructor._coming is None or reconstructor._coming.wait()
    assert (picture.binning, picture.method) == (3, "admm-sensor")
    assert [w.split(":")[0][-5:] for w in reconstructor.warnings] == ["1 x 1", "2 x 2"]


def test_without_memory_for_any_solver_the_wiener_filter_goes_on(lacking: set[int]) -> None:
    lacking.update((1, 2))
    reconstructor = live(coarsest=2, budget_ms=AMPLE_MS)
    for n in range(6):
        picture = reconstructor.feed(photograph(0, n))
        if reconstructor._coming is not None:
            reconstructor._coming.wait()
        assert picture.method == "wiener"
    assert reconstructor.refine() is None
    assert len(reconstructor.warnings) == 2
    assert "Wiener filter's" in reconstructor.warnings[0]


def test_an_error_in_making_a_level_is_told_by_the_next_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: Level) -> Level:
        raise ValueError("broken")

    monkeypatch.setattr(Level, "solving", broken)
    reconstructor = live()
    reconstructor.feed(photograph(0, 0))
    assert reconstructor._coming is not None
    reconstructor._coming.wait()
    with pytest.raises(ValueError, match="broken"):
        reconstructor.feed(photograph(0, 1))
