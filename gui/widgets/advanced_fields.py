"""What a reconstruction is rarely asked for, folded away: mosaic, choices, when to stop, where to compute."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QCheckBox, QComboBox, QFormLayout, QToolButton, QVBoxLayout, QWidget

from gui.widgets.entry import Entry, PathEntry, existing_path, narrow, number
from instrument.reconstruction.kept_request import require_kept
from instrument.reconstruction.mosaic import mosaic_named
from instrument.reconstruction.request import PictureRequest, VolumeRequest, known_device
from instrument.reconstruction.words import parse_wishes
from recon.base.namespace import DEVICES
from recon.camera.bayer import PATTERNS

TURNS = {"as on the sensor": 0, "by 90°": 90, "by 180°": 180, "by 270°": 270}


class AdvancedFields(QWidget):
    """A heading that opens and closes a form; closed, what is set in it holds all the same.

    Parameters
    ----------
    parent : QWidget, optional
    """

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.fold = QToolButton()
        self.fold.setText("Advanced")
        self.fold.setCheckable(True)
        self.fold.setAutoRaise(True)
        self.fold.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextBesideIcon)
        self.fold.setToolTip("Mosaic, choices, when to stop, checkpoint, memory")
        self.fold.toggled.connect(self._fold)
        self.mosaic = _choice(
            ["auto", "none", *PATTERNS],
            "The photograph is a raw frame of a colour mosaic; auto: by what its metadata say",
        )
        self.choose = Entry(
            lambda text: parse_wishes("auto", _words(text)),
            tip="Overrule what auto chooses: NAME=VALUE, e.g. binning=1 planes=all background=off",
            placeholder="all to the program",
        )
        self.tolerance = Entry(
            number("The tolerance", "", above_zero=True),
            tip="Stop at this relative change per iteration",
            placeholder="the method's",
        )
        self.at_noise = QCheckBox("stop at the noise")
        self.at_noise.setToolTip("Stop when the residual is as small as the noise")
        self.turn = _choice(list(TURNS), "Turn the picture that is written, counter-clockwise")
        self.saturated = QCheckBox("PSF may be saturated")
        self.saturated.setToolTip("Use a PSF although pixels of it are saturated")
        self.mixed_depth = QCheckBox("PSF may be of another depth")
        self.mixed_depth.setToolTip("Use a PSF although its distance differs from the photograph's")
        self.positive = QCheckBox("background nowhere negative")
        self.positive.setToolTip("Estimate a background that is nowhere negative")
        self.checkpoint = Entry(
            lambda text: Path(text).expanduser() if text else None,
            tip="Folder in which the work is kept while it runs: started again, it goes on from there",
            placeholder="not kept",
        )
        self.scratch = Entry(
            lambda text: existing_path(text) if text else None,
            tip="Folder on a fast disk for what does not fit into memory",
            placeholder="none",
        )
        self.memory_gib = Entry(
            number("The memory", "GiB", above_zero=True),
            tip="Memory that may be taken, GiB",
            placeholder="what is free (GiB)",
        )
        self.device = _choice(list(DEVICES), "Where to compute")
        self._scratch_row = PathEntry(self.scratch, "folder")
        self._rows = QFormLayout()
        self._rows.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        self._rows.setContentsMargins(0, 2, 0, 0)
        self._rows.setVerticalSpacing(4)
        for name, widget in (
            ("Mosaic", self.mosaic),
            ("Choose", self.choose),
            ("Tolerance", self.tolerance),
            ("", self.at_noise),
            ("Turned", self.turn),
            ("", self.saturated),
            ("", self.mixed_depth),
            ("", self.positive),
            ("Checkpoint", PathEntry(self.checkpoint, "folder")),
            ("Scratch", self._scratch_row),
            ("Memory", self.memory_gib),
            ("Compute on", self.device),
        ):
            self._rows.addRow(name, widget)
        self._inside = QWidget()
        self._inside.setLayout(self._rows)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.fold, 0, Qt.AlignmentFlag.AlignLeft)
        column.addWidget(self._inside)
        self._fold(opened=False)

    @property
    def entries(self) -> list[Entry]:
        """The fields that may be refused."""
        return [self.choose, self.tolerance, self.checkpoint, self.scratch, self.memory_gib]

    def show_for(self, *, volume: bool, psf: bool) -> None:
        """Show what applies to a volume or a picture, from a PSF's image or from a calibration."""
        shown = {self.turn: not volume, self.positive: volume, self.device: volume, self.memory_gib: volume}
        shown |= {self.saturated: psf, self.mixed_depth: psf, self._scratch_row: volume}
        for widget, visible in shown.items():
            self._rows.setRowVisible(widget, visible)

    def apply(self, request: PictureRequest | VolumeRequest) -> PictureRequest | VolumeRequest:
        """Return a request with what is set here.

        Raises
        ------
        BenchError
            When a field is not understood, or does not go with the others.
        """
        settings = replace(
            request.settings,
            mosaic=mosaic_named(self.mosaic.currentText()),
            wishes=parse_wishes(request.settings.model, _words(self.choose.text())),
            tolerance=self.tolerance.value(),
            stop_at_noise=self.at_noise.isChecked(),
        )
        made: PictureRequest | VolumeRequest
        if isinstance(request, VolumeRequest):
            made = replace(
                request,
                settings=settings,
                positive_background=self.positive.isChecked(),
                scratch=self.scratch.value(),
                memory_gib=self.memory_gib.value(),
                device=known_device(self.device.currentText()),
            )
        else:
            from_psf = request.psf is not None
            made = replace(
                request,
                settings=settings,
                allow_saturated=from_psf and self.saturated.isChecked(),
                allow_mixed_depth=from_psf and self.mixed_depth.isChecked(),
            )
        if self.kept_in is not None:
            require_kept(made)
        return made

    @property
    def kept_in(self) -> Path | None:
        """The checkpoint's folder; BenchError as the field."""
        folder: Path | None = self.checkpoint.value()
        return folder

    @property
    def rotate_deg(self) -> int:
        """How the picture that is written is turned, counter-clockwise."""
        return TURNS[self.turn.currentText()]

    def reveal(self, entry: Entry) -> None:
        """Open the fold where a field in it was refused."""
        if entry in self.entries:
            self.fold.setChecked(True)

    def _fold(self, opened: bool) -> None:
        self.fold.setArrowType(Qt.ArrowType.DownArrow if opened else Qt.ArrowType.RightArrow)
        self._inside.setVisible(opened)


def _words(text: str) -> list[str]:
    return [part for part in re.split(r"[,\s]+", text) if part]


def _choice(names: list[str], tip: str) -> QComboBox:
    box = QComboBox()
    box.addItems(names)
    box.setToolTip(tip)
    narrow(box)
    return box
