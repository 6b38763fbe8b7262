"""Micro-Manager's core with one SLM, as far as its documentation says what it does."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


class FakeSlmCore:
    def __init__(self, label: str, shape: tuple[int, int]) -> None:
        self.label, self.shape = label, shape
        self.shown: npt.NDArray[np.uint8] | None = None
        self._loaded: npt.NDArray[np.uint8] | None = None

    def getLoadedDevices(self) -> tuple[str, ...]:
        return (self.label, "Core")

    def getDevicePropertyNames(self, label: str) -> tuple[str, ...]:
        return ("Name",)

    def hasProperty(self, label: str, name: str) -> bool:
        return name == "Name"

    def getProperty(self, label: str, name: str) -> str:
        return "fake"

    def getDeviceLibrary(self, label: str) -> str:
        return "Fake"

    def getDeviceName(self, label: str) -> str:
        return "SLM"

    def getVersionInfo(self) -> str:
        return "MMCore version 0"

    def getSLMHeight(self, label: str) -> int:
        return self.shape[0]

    def getSLMWidth(self, label: str) -> int:
        return self.shape[1]

    def getSLMBytesPerPixel(self, label: str) -> int:
        return 1

    def setSLMImage(self, label: str, levels: npt.NDArray[np.uint8]) -> None:
        assert levels.shape == self.shape
        assert levels.flags.c_contiguous
        self._loaded = levels.copy()

    def displaySLMImage(self, label: str) -> None:
        self.shown = self._loaded

    def unloadAllDevices(self) -> None:
        self.shown = None
