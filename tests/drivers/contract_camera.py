"""Its old place, until every test imports it from ``drivers.testing``."""

from drivers.testing.camera import CameraContract as CameraContract
