"""Live pictures: the newest frame in, a picture out, in bounded time; quality gives way, never time."""

from recon.live.reconstructor import LivePicture, LiveReconstructor
from recon.live.stillness import SceneState, SceneWatch

__all__ = ["LivePicture", "LiveReconstructor", "SceneState", "SceneWatch"]
