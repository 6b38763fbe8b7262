"""What GenICam cameras have in common, over a camera that is a table of features."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest

from drivers.errors import DeviceError, LimitError
from drivers.genicam.camera import GenicamCamera, GenicamOptions
from drivers.genicam.features import FeatureKind, Features


class Table(Features):
    """Features by name: numbers ``[value, low, high, step]``, choices ``[entry, *offered]``, switches."""

    listed_by = "this test"

    def __init__(self, **features: Any) -> None:
        super().__init__("camera (table)")
        self.of = features

    @contextlib.contextmanager
    def words(self, doing: str) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            raise DeviceError(self.name, f"did not {doing}: {error}.") from error

    def find(self, *names: str) -> str | None:
        return next((name for name in names if name in self.of), None)

    def kind(self, name: str) -> FeatureKind | None:
        if name not in self.of:
            return None
        value = self.of[name]
        return "switch" if isinstance(value, bool) else "choice" if isinstance(value[0], str) else "number"

    def number(self, name: str) -> float:
        return float(self.of[name][0])

    def bounds(self, name: str) -> tuple[float, float]:
        return float(self.of[name][1]), float(self.of[name][2])

    def increment(self, name: str) -> int:
        return int(self.of[name][3])

    def _write_number(self, name: str, value: float) -> None:
        _, low, high, step = self.of[name]
        if not low <= value <= high or (step and (value - low) % step):
            raise ValueError(f"{value!r} is not within {low} to {high} in steps of {step}")
        self.of[name][0] = value

    def unit(self, name: str) -> str:
        return "dB" if name == "Gain" else ""

    def text(self, name: str) -> str:
        value = self.of[name]
        return str(value).lower() if isinstance(value, bool) else str(value[0])

    def entries(self, name: str) -> tuple[str, ...]:
        return tuple(self.of[name][1:])

    def _write_text(self, name: str, value: str) -> None:
        self.of[name][0] = value

    def _write_switch(self, name: str, value: bool) -> None:
        self.of[name] = value

    def _execute(self, name: str) -> None:
        raise ValueError("nothing to execute")


def test_a_number_is_brought_to_the_nearest_that_the_camera_takes() -> None:
    features = Table(
        ExposureTime=[9.0, 1001.0, 59_000.5, 0], Width=[6, 6, 1023, 4], Offset=[0, -(2**63), 2**63 - 1, 1]
    )
    for limit_us in (1001.0, 59_000.5):
        assert features.set_number("ExposureTime", limit_us / 1e3 * 1e3) == limit_us  # a rounding apart
    assert 1001.0 / 1e3 * 1e3 != 1001.0
    assert features.set_number("Width", 1023) == 1022  # the largest on its steps
    assert features.set_number("Width", 13) == 14
    assert features.set_number("Offset", 4660) == 4660


def test_a_switch_is_not_on_because_a_word_was_given() -> None:
    features = Table(ReverseX=True)
    for word, on in (("false", False), ("True", True), (0, False), (1, True), (False, False)):
        features.set_any("ReverseX", word)
        assert features.of["ReverseX"] is on
    with pytest.raises(LimitError, match=r"takes no ReverseX 'off'\. It takes true, false\."):
        features.set_any("ReverseX", "off")
    assert features.of["ReverseX"] is False


class OfTable(GenicamCamera):
    """A camera without frames; colour, and turning its pixels changes the order of its mosaic."""

    name = "camera (table)"
    _connected = True

    def __init__(self, table: Table, **options: Any) -> None:
        super().__init__()
        self.options = GenicamOptions(pixel_pitch_um=3.0, **options)
        self._features = table
        self._prepare()


OfTable.__abstractmethods__ = frozenset()


class Turning(Table):
    """The formats that it offers follow the switch."""

    def _write_switch(self, name: str, value: bool) -> None:
        super()._write_switch(name, value)
        if name == "ReverseX":
            old, new = ("RG", "GR") if value else ("GR", "RG")
            self.of["PixelFormat"] = [entry.replace(old, new) for entry in self.of["PixelFormat"]]
            self.of["Gain"][0] = 6.0


def table(**more: Any) -> Turning:
    return Turning(
        **{
            "ExposureTime": [1e4, 20.0, 1e6, 0],
            "Gain": [0.0, 0.0, 24.0, 0],
            "PixelFormat": ["BayerRG12", "BayerRG12"],
            "ReverseX": False,
            "SensorHeight": [48, 48, 48, 1],
            "SensorWidth": [64, 64, 64, 1],
            "Height": [48, 2, 48, 2],
            "Width": [64, 2, 64, 2],
            "OffsetX": [0, 0, 62, 2],
            "OffsetY": [0, 0, 46, 2],
            **more,
        }
    )


def test_what_somebody_left_set_does_not_outlive_the_opening() -> None:
    features = table(
        ExposureMode=["TriggerWidth", "Timed", "TriggerWidth"],
        ExposureAuto=["Continuous", "Off", "Continuous"],
        DecimationHorizontal=[2, 1, 4, 1],
    )
    OfTable(features)  # type: ignore[abstract]
    said = [features.text(name) for name in ("ExposureMode", "ExposureAuto", "DecimationHorizontal")]
    assert said == ["Timed", "Off", "1"]


def test_a_feature_that_changes_the_images_is_known_to_have() -> None:
    camera = OfTable(table(), features={"ReverseX": True, "Width": 32})  # type: ignore[abstract]
    assert (camera.pixel_format, camera.pixel_formats) == ("BayerGR12", ("BayerGR12",))
    assert camera.roi.as_tuple() == (0, 0, 48, 32)
    assert camera.gain == pytest.approx(10 ** (6 / 20))
    camera.set_pixel_format("BayerGR12")
    camera.set_own("ReverseX", "false")
    assert camera.pixel_format == "BayerRG12"
    camera._remembered["pixel_format"]()  # as the camera has it now
    camera._features.of["PixelFormat"] = ["YUV422", "YUV422", "BayerRG12"]  # type: ignore[attr-defined]
    with pytest.raises(DeviceError, match=r"sends YUV422, which cannot be read\. Readable: BayerRG12"):
        camera._look_again()


def test_the_format_that_was_set_comes_back_with_what_turned_its_mosaic() -> None:
    def fresh() -> Turning:
        return table(PixelFormat=["BayerRG12", "BayerRG12", "BayerRG8"])

    camera = OfTable(fresh(), features={"ReverseX": False})  # type: ignore[abstract]
    camera.set_pixel_format("BayerRG8")
    camera.set_own("ReverseX", "true")
    for _ in range(2):
        assert camera.pixel_format == "BayerGR8"
        camera._features = fresh()  # lost, and opened again
        camera._prepare()
        camera._bring_back()
    assert camera.pixel_format == "BayerGR8"


class Blinding(Turning):
    """Turned, it sends what cannot be read."""

    def _write_switch(self, name: str, value: bool) -> None:
        super()._write_switch(name, value)
        self.of["PixelFormat"] = ["YUV422", "YUV422", "BayerGR8"] if value else ["BayerRG12", "BayerRG12"]


def test_a_feature_that_makes_the_images_unreadable_is_set_back_and_not_remembered() -> None:
    camera = OfTable(Blinding(**table().of), features={"ReverseX": False})  # type: ignore[abstract]
    with pytest.raises(DeviceError, match="sends YUV422, which cannot be read"):
        camera.set_own("ReverseX", "true")
    assert (camera._features.text("ReverseX"), camera._remembered) == ("false", {})
    assert (camera.pixel_format, camera.significant_bits) == ("BayerRG12", 12)
    camera._features.of["PixelFormat"] = ["YUV422", "YUV422", "Mono8"]  # type: ignore[attr-defined]
    with pytest.raises(DeviceError, match="cannot be read"):
        camera._look_again()
    assert (camera.pixel_formats, camera.significant_bits) == (("BayerRG12",), 12)


class Balancing(Table):
    """Has done at once what it is to do once."""

    def _write_text(self, name: str, value: str) -> None:
        super()._write_text(name, "Off" if value == "Once" else value)
        self.of["Times"][0] += value == "Once"


def test_what_was_done_once_is_not_done_again_when_a_lost_camera_is_back() -> None:
    features = Balancing(**table(TintAuto=["Off", "Off", "Once", "Continuous"], Times=[0, 0, 9, 1]).of)
    camera = OfTable(features, features={"TintAuto": "Continuous"})  # type: ignore[abstract]
    for value in ("Continuous", "Once"):
        camera.set_own("TintAuto", value)
    camera._prepare()  # lost, and opened again
    camera._bring_back()
    assert (features.text("TintAuto"), features.number("Times")) == ("Off", 1)


class Locking(Table):
    """Locks the switch of its frame rate while it waits for triggers."""

    def _write_switch(self, name: str, value: bool) -> None:
        if name == "AcquisitionFrameRateEnable" and self.text("TriggerMode") == "On":
            raise ValueError("it is not writable")
        super()._write_switch(name, value)


class Deaf(Table):
    """Has another entry than it was told."""

    def _write_text(self, name: str, value: str) -> None:
        super()._write_text(name, "C" if value == "B" else value)


def test_a_feature_that_is_another_than_was_told_is_set_back() -> None:
    features = Deaf(**table(Look=["A", "A", "B", "C"]).of)
    camera = OfTable(features, features={"Look": "A"})  # type: ignore[abstract]
    with pytest.raises(DeviceError, match="was told Look = B and has C"):
        camera.set_own("Look", "B")
    assert (features.text("Look"), camera._remembered) == ("A", {})


def test_no_frame_rate_holds_triggers_back() -> None:
    lines = {"TriggerMode": ["Off", "On", "Off"], "TriggerSource": ["Line1", "Line1", "Software"]}
    for options in ({}, {"frames_per_s": 20.0}):
        rate = {"AcquisitionFrameRate": [5.0, 1.0, 100.0, 0], "AcquisitionFrameRateEnable": True}
        features = Locking(**table(**rate).of)
        features.of |= {name: list(value) for name, value in lines.items()}
        camera = OfTable(features, **options)  # type: ignore[abstract]
        for mode, limited in (
            ("free_run", True),
            ("hardware", False),
            ("software", False),
            ("free_run", True),
        ):
            camera.set_trigger_mode(mode)  # type: ignore[arg-type]
            camera._apply_rate()
            assert features.of["AcquisitionFrameRateEnable"] is limited
        assert features.number("AcquisitionFrameRate") == options.get("frames_per_s", 5.0)
