"""The live view: the camera's newest frame, at most thirty times a second."""

from __future__ import annotations

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QLabel, QVBoxLayout, QWidget

from drivers.frame import Frame
from gui.panel import Panel
from gui.session import BenchSession
from gui.widgets.image_view import ImageView

_INTERVAL_MS = 33


class LivePanel(Panel):
    """Shows the newest frame of the live view; owns nothing of it."""

    title = "Live view"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.view = ImageView()
        self.status = QLabel()
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.view, 1)
        layout.addWidget(self.status)
        self._shown: Frame | None = None
        self._timer = QTimer(self)
        self._timer.timeout.connect(self._look)
        self._timer.start(_INTERVAL_MS)

    def as_python(self) -> str:
        """Return lines that look at the camera's newest frames."""
        path = self.session.config.path
        return (
            "from instrument.bench import open_bench\n"
            "from instrument.live_view import LiveView\n\n"
            f"with open_bench({str(path) if path else None!r}) as bench:\n"
            "    live = LiveView(bench.camera)\n"
            "    live.start()\n"
            "    frame = live.newest()\n"
        )

    def shutdown(self) -> None:
        """End the timer."""
        self._timer.stop()

    def _look(self) -> None:
        frame = self.session.live.newest()
        if frame is None or frame is self._shown:
            return
        self._shown = frame
        self.view.show_image(frame.image, 0, frame.full_scale, frame.full_scale)
        now = self.session.live.status()
        self.status.setText(f"{now.frames_per_s:.1f} frames/s, {now.dropped} dropped")
