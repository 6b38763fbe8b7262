"""Devices on another computer: the contract suites over loopback."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drivers.device import Device
from drivers.errors import LimitError
from drivers.remote.camera import RemoteCamera
from drivers.remote.light_and_motion import RemoteLedArray, RemoteSlm, RemoteStage
from drivers.remote.options import RemoteOptions
from drivers.testing.camera import CameraContract
from drivers.testing.led_array import LedArrayContract
from drivers.testing.slm import SlmContract
from drivers.testing.stage import StageContract
from instrument.bench.config_file import parse_config
from instrument.serve import uploads

BENCH = """
[simulated]
preset = "tiny"
time_scale = 0.05
scene = "none"
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[slm]
driver = "simulated"
shape = [60, 80]
"""
TOKEN = "a-token-for-tests"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RemoteOptions]:
    pytest.importorskip("aiohttp", reason='pip install "diffuserbench[remote]"')
    from instrument.serve.server import BenchServer, Serving

    file = tmp_path_factory.mktemp("served") / "token"
    file.write_text(f"{TOKEN}\n")
    with BenchServer(parse_config(BENCH, None), Serving(token=TOKEN, port=0)) as server:
        yield RemoteOptions(url=server.url, token_file=str(file))


class Over:
    """Makes devices of a server on loopback."""

    driver: type[Device]

    @pytest.fixture(autouse=True)
    def _served(self, served: RemoteOptions) -> None:
        self._options = served

    def make(self) -> Device:
        return self.driver(self._options)


class TestCamera(Over, CameraContract):
    driver = RemoteCamera


class TestStage(Over, StageContract):
    driver = RemoteStage


class TestLedArray(Over, LedArrayContract):
    driver = RemoteLedArray


class TestSlm(Over, SlmContract):
    driver = RemoteSlm

    def test_patterns_are_sent_in_pieces(self, monkeypatch: pytest.MonkeyPatch) -> None:
        sizes: list[int] = []

        def heard(uploads: Uploads, operator: str, name: str, size: int, place: int, piece: bytes) -> None:
            sizes.append(len(piece))
            add(uploads, operator, name, size, place, piece)

        from instrument.serve.uploads import Uploads

        add = Uploads.add
        monkeypatch.setattr(Uploads, "add", heard)
        monkeypatch.setattr("drivers.remote.link.PIECE_BYTES", 1000)
        with RemoteSlm(self._options) as slm:
            levels = np.arange(60 * 80, dtype=np.uint8).reshape(60, 80)
            slm.display(levels)
            assert max(sizes) == 1000
            assert sum(sizes) == levels.size + 128  # with what NumPy writes before it
            np.testing.assert_array_equal(slm._ask("displayed"), levels)
            slm.display(np.asfortranarray(levels[::-1]))
            np.testing.assert_array_equal(slm._ask("displayed"), levels[::-1])
            slm.arm([levels, levels[::-1]], 50.0)
            slm.play()

    def test_a_sequence_that_no_request_holds_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("drivers.remote.light_and_motion.LONGEST_ARRAYS", 3 * 60 * 80)
        with RemoteSlm(self._options) as slm:
            images = [np.zeros(slm.shape, np.uint8)] * 3
            assert slm.sequence_limits is not None
            assert slm.sequence_limits.most == 2
            assert slm.arm(images[:2], 50.0) == 50.0
            with pytest.raises(LimitError, match="1 to 2 patterns, not 3"):
                slm.arm(images, 50.0)


def test_uploads_are_whole_or_nothing_and_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "LONGEST_ARRAYS", 10)
    kept = uploads.Uploads()
    kept.add("me", "1", 5, 3, b"de")
    with pytest.raises(ValueError, match="came twice"):
        kept.add("me", "1", 5, 3, b"de")
    with pytest.raises(ValueError, match="did not come whole"):
        kept.take("me", "1")
    kept.add("me", "1", 5, 3, b"de")
    kept.add("me", "1", 5, 0, b"abc")
    with pytest.raises(ValueError, match="did not come whole"):
        kept.take("another", "1")
    assert bytes(kept.take("me", "1")) == b"abcde"
    for size, place, piece in ((11, 0, b"a"), (0, 0, b""), (5, 4, b"ab"), (5, -1, b"a")):
        with pytest.raises(ValueError, match=r"cannot be sent|no piece"):
            kept.add("me", "2", size, place, piece)
    for word in ("3", "4", "5"):  # the first is given up, as three do not fit
        kept.add("me", word, 5, 0, b"abcde")
    with pytest.raises(ValueError, match="did not come whole"):
        kept.take("me", "3")
    kept.forget("me")
    with pytest.raises(ValueError, match="did not come whole"):
        kept.take("me", "5")
