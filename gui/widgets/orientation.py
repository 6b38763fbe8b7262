"""Turning and mirroring pictures, kept with the bench: all of a kind alike, in every panel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from PySide6.QtGui import QImage, QTransform
from PySide6.QtWidgets import QMenu, QPushButton

from gui.session import BenchSession
from instrument.files.errors import FileError
from instrument.files.orientation import AS_IT_IS, Kind, Orientation
from instrument.files.reading import parse_json, read_bytes

_KEPT = "orientation"


def usual_orientation(session: BenchSession, kind: Kind) -> Orientation:
    """Return how pictures of a kind are turned where nobody has said it.

    What a camera's lens or diffuser makes of a scene lies upside down on the sensor. Of the simulated camera
    it is known that nothing turns it back; others may be mounted any way.
    """
    camera = session.config.devices.get("camera")
    is_simulated = camera is not None and camera.driver_name == "simulated"
    return Orientation(2) if kind == "results" and is_simulated else AS_IT_IS


def orientation_of(session: BenchSession, kind: Kind) -> Orientation:
    """Return how pictures of a kind are turned."""
    kept = session.kept.of(_KEPT).get(kind)
    return usual_orientation(session, kind) if kept is None else Orientation.of(kept)


def read_turned(path: Path, orientation: Orientation) -> QImage:
    """Read a picture from a file; the preview of a result, beside its record, is turned as results are."""
    picture = QImage(str(path))
    try:
        record = parse_json(read_bytes(path.with_suffix(".json")))
    except (OSError, ValueError, FileError):  # there is none, or another program's
        return picture
    if not isinstance(record, dict) or "preview" not in record:
        return picture
    a, b, c, d = orientation.matrix
    return picture.transformed(QTransform(a, c, b, d, 0, 0))


def follow_orientation(session: BenchSession, kind: Kind, show: Callable[[Orientation], object]) -> None:
    """Have something called with how pictures of a kind are turned, now and whenever that changes."""

    def changed() -> None:
        show(orientation_of(session, kind))

    session.kept_changed.connect(changed)
    changed()


class OrientationButton(QPushButton):
    """A button with a menu that turns and mirrors all pictures of a kind.

    Parameters
    ----------
    session : BenchSession
    kind : str
        ``"frames"``: pictures of the camera, wherever they are shown; ``"results"``: reconstructed ones.
    tip : str
    """

    def __init__(self, session: BenchSession, kind: Kind, tip: str) -> None:
        super().__init__("⟳")
        self.setAccessibleName("Turn and mirror")
        self.setCheckable(True)
        self._session, self._kind = session, kind
        self.orientation = AS_IT_IS
        self._tip = tip
        menu = QMenu(self)
        for words, turn in (
            ("Turn left", lambda now: now.turned(1)),
            ("Turn right", lambda now: now.turned(3)),
            ("Mirror left and right", lambda now: now.flipped(upright=False)),
            ("Mirror top and bottom", lambda now: now.flipped(upright=True)),
            ("As on the sensor", lambda _: AS_IT_IS),
        ):
            menu.addAction(words).triggered.connect(partial(self._turn, turn))
        self.setMenu(menu)
        follow_orientation(session, kind, self._show)

    def _turn(self, turn: Callable[[Orientation], Orientation], _checked: bool = False) -> None:
        made = turn(self.orientation)
        kept = {"quarters": made.quarters, "mirrored": made.mirrored}
        usual = usual_orientation(self._session, self._kind)
        self._session.keep(_KEPT, self._kind, kept if made != usual else None)

    def _show(self, orientation: Orientation) -> None:
        self.orientation = orientation
        now = orientation.words or "as on the sensor"
        self.setToolTip(f"{self._tip} Kept with the bench. Now: {now}.")
        self.setChecked(orientation != AS_IT_IS)
