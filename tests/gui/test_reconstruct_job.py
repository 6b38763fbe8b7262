"""What a reconstruction in the window says while it runs."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import tifffile

from gui.forms.reconstruct import ReconstructionWork, SoFar, reconstruct_job
from instrument.reconstruction.checkpointing import CheckpointFolder
from instrument.reconstruction.foretold import Like
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.request import PictureRequest
from instrument.reconstruction.result_file import Outputs
from recon.reconstruction.options import ReconstructionOptions


class Reading:
    """Takes every note that a job reports or offers."""

    def __init__(self) -> None:
        self.cancel = threading.Event()
        self.notes: list[str] = []

    def report(self, value: SoFar) -> None:
        self.notes.append(value.note)

    def offer(self, make: Callable[[], SoFar]) -> None:
        self.report(make())


def test_a_forecast_is_told_in_the_place_of_the_one_before_and_a_warning_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    psf = np.where(rng.random((32, 32)) > 0.97, 900, 0).astype(np.uint16)
    for name, image in (("psf", psf), ("image", 3 * np.roll(psf, (3, -2), (0, 1)) + 20)):
        tifffile.imwrite(tmp_path / f"{name}.tif", image.astype(np.uint16))
    kept = tmp_path / "kept"
    monkeypatch.setattr(Like, "took", lambda _: (86400.0, 0.0))
    monkeypatch.setitem(CheckpointFolder.__init__.__kwdefaults__ or {}, "every_s", 0.0)
    keep = CheckpointFolder.keep

    def keeping(*given: Any, **named: Any) -> None:
        shutil.rmtree(kept, ignore_errors=True)  # as somebody does meanwhile
        keep(*given, **named)

    monkeypatch.setattr(CheckpointFolder, "keep", keeping)
    options = ReconstructionOptions(iterations=30, tolerance=0, model="convolution")
    request = PictureRequest(
        image=tmp_path / "image.tif", inputs=InputOptions(dark=0), options=options, psf=tmp_path / "psf.tif"
    )
    context = Reading()
    work = ReconstructionWork(request, Outputs.named(tmp_path / "out.tif", volume=False), kept)
    reconstruct_job(work, cast(Any, context))
    assert "by the last like it" in context.notes[1]
    assert "by the last like it" not in context.notes[-1]
    assert max(note.count("in all") for note in context.notes) == 1
    assert "The work goes on" in context.notes[-1]
