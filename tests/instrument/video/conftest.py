"""Fixtures of videos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.instrument.video.recorded import MISSING, cast, request, scene, solved
from tests.mocks.recordings import write_recording


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    np.save(folder / "psf.npy", cast([(0, 0, 100.0)]).astype(np.float32))
    frames = {t: scene(t) for t in range(11) if t != MISSING}
    return write_recording(folder, frames)


@pytest.fixture(scope="session")
def video(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("video")
    solved(request(recording, folder))
    return folder
