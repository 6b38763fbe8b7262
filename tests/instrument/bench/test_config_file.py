"""bench.toml: what is right is understood, every mistake is named with its line and what would be right."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from instrument.bench.config import CameraTable
from instrument.bench.config_file import load_config, parse_config
from instrument.files.errors import ConfigError, FileError
from tests.mocks.devices import MockOptions, MockStage

pytestmark = pytest.mark.usefixtures("mock_drivers")

GOOD = """\
[bench]
name = "test bench"
data_folder = "data"
[camera]
driver = "mock"
exposure_ms = 5
roi = [0, 0, 8, 16]
port = "usb1"
[stage]
driver = "mock"
speed_mm_s = 2.5
[mock]
level = 7
"""


def mistakes(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, Path("bench.toml"))
    return str(caught.value).splitlines()[1:]


def test_a_good_file_gives_drivers_options_and_common_settings() -> None:
    config = parse_config(GOOD, Path("/somewhere/bench.toml"))
    camera, stage = config.devices["camera"], config.devices["stage"]
    assert isinstance(camera.settings, CameraTable)
    assert (camera.settings.exposure_ms, camera.settings.roi) == (5.0, (0, 0, 8, 16))
    assert isinstance(camera.options, MockOptions)
    assert camera.options.port == "usb1"
    assert stage.driver is MockStage
    assert config.shared["mock"].options.model_dump() == {"level": 7}
    assert config.data_folder == Path("/somewhere/data")
    assert set(config.devices) == {"camera", "stage"}


def test_the_configuration_as_used_contains_the_defaults() -> None:
    used = parse_config(GOOD, None).as_dict()
    assert used["camera"]["driver"] == "mock"
    assert used["camera"]["gain"] is None
    assert used["stage"]["port"] == "none"
    assert used["source"]["leds"] == [0]


MANY = """\
colour = 1
[bench]
nmae = "x"
[camera]
driver = "mock"
exposure_s = 0.01
gain = "high"
roi = [1, 2, 3]
prot = "usb"
speed_mm_s = true
[stage]
driver = "mokc"
[led_array]
[scene]
control = "magic"
[source]
leds = [0, 1.5]
rgb = [0, 0, 256]
[mock]
level = 5000
[moc]
x = 1
"""

EXPECTED = [
    r":1: colour: this key stands outside every table.*\[?camera",
    r":3: \[bench\] nmae: there is no such key\. Did you mean 'name'\? Keys here: name, data_folder\.",
    r":6: \[camera\] exposure_s: .*'exposure_ms'\? exposure_s = 0\.01 would be exposure_ms = 10\.",
    r":7: \[camera\] gain: must be a (valid )?number, not 'high'\. .*factor",
    r":8: \[camera\] roi.*top, left, height, width",
    r":9: \[camera\] prot: there is no such key.*'port'\? Keys here: driver, exposure_ms.*fail",
    r":10: \[camera\] speed_mm_s: must be a (valid )?number, not True",
    r":12: \[stage\] driver: no driver is called 'mokc'.* 'mock'\? Drivers there are: .*simulated",
    r":13: \[led_array\] driver: this key is missing\. Drivers there are: .*mock",
    r":15: \[scene\] control: must be 'simulated' or 'operator', not 'magic'",
    r":17: \[source\] leds\[1\]: must be .*integer.*not 1\.5",
    r":18: \[source\] rgb\[2\]: must be less than or equal to 255, not 256",
    r":20: \[mock\] level: must be less than or equal to 4095, not 5000",
    r":21: \[moc\]: no such table.*Did you mean 'mock'",
]


def test_all_mistakes_are_named_at_once_with_line_and_what_is_allowed() -> None:
    found = mistakes(MANY)
    assert len(found) == len(EXPECTED)
    for line, pattern in zip(found, EXPECTED, strict=True):
        assert re.search(pattern, line), f"{line!r} does not match {pattern!r}"


def test_a_misspelt_driver_does_not_hide_the_other_mistakes_of_its_table() -> None:
    found = mistakes('[camera]\ndriver = "mokc"\nexposure_s = 0.01\nprot = "usb"\n[mock]\nlevel = -1\n')
    assert [line.split(":")[1] for line in found] == ["2", "3", "4", "6"]
    assert "exposure_ms = 10" in found[1]
    found = mistakes('[camera]\ndriver = "nothing_like_it"\nexposure_ms = "long"\nown_key = 1\n')
    assert [line.split(":")[1] for line in found] == ["2", "3"]


def test_an_unknown_table_is_refused_with_the_nearest_name() -> None:
    (found,) = mistakes('[camera]\ndriver = "mock"\n[gemetry]\npixel_pitch_um = 1.0\n')
    assert re.search(r":3: \[gemetry\]: no such table.*Did you mean 'geometry'", found)
    (found,) = mistakes('[camera]\ndriver = "mock"\n[led]\ndriver = "mock"\n')
    assert re.search(r":3: \[led\]: no such table.*Did you mean 'led_array'", found)


def test_an_led_of_the_source_that_no_array_can_have_is_a_mistake() -> None:
    (found,) = mistakes('[camera]\ndriver = "mock"\n[source]\nleds = [0, -4]\n')
    assert re.search(r":4: \[source\] leds\[1\]: must be greater than or equal to 0, not -4", found)


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("", r"bench\.toml: \[camera\]: this table is missing"),
        ("camera = 3\n", r":1: camera: must be a table"),
        ('[camera]\ndriver = 3\n', r":2: \[camera\] driver: must be a text"),
        ('[camera]\ndriver = "mock"\n[stage]\ndriver = "absent"\n', r":4: .*cannot be imported.*a_package"),
        ('[camera\ndriver = "mock"\n', r":1: broken TOML: .*'\[camera'"),
        ('[camera]\ndriver = "mock\n', r":2: broken TOML"),
        ('[camera]\ndriver = "mock"\ndriver = "mock"\n', r":3: broken TOML"),
        ('[camera]\ndriver = "mock"\nexposure_ms = nan\n', r":3: \[camera\] exposure_ms: must be"),
        ('[camera]\ndriver = "mock"\nexposure_ms = -1\n', r":3: .*must be greater than 0, not -1"),
        ('[camera]\ndriver = "mock"\nexposure_ms = 1979-05-27\n', r":3: .*must be a"),
        ('[camera]\ndriver = "mock"\n[[stage]]\nx = 1\n', r":3: stage: must be a table"),
    ],
)  # fmt: skip
def test_single_mistakes(text: str, pattern: str) -> None:
    assert any(re.search(pattern, line) for line in mistakes(text)), mistakes(text)


def test_bench_toml_of_the_working_folder_is_meant_unless_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench.toml").write_text(GOOD)
    assert load_config().bench.name == "test bench"


@pytest.mark.parametrize(
    ("name", "pattern"), [("absent.toml", "no such file.*diffuserbench new"), (".", "is a folder")]
)
def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path, name: str, pattern: str) -> None:
    with pytest.raises(FileError, match=pattern):
        load_config(tmp_path / name)


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileError, match="not UTF-8"):
        load_config(tmp_path / "bench.toml")
