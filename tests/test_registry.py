"""Drivers are found by name; an unknown, a broken and an ambiguous one are refused in words."""

import os
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from drivers.errors import DeviceError
from drivers.registry import registry
from drivers.registry.registry import GROUP, KINDS, driver_names, load_driver, registration_mistakes
from instrument.bench.config_file import load_config
from instrument.files.errors import ConfigError

Register = Callable[..., None]


@pytest.mark.parametrize("kind", KINDS)
def test_the_simulated_driver_of_each_kind_is_registered(kind: str) -> None:
    assert "simulated" in driver_names(kind)


def test_an_unknown_driver_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(DeviceError, match=r"stage \(flying_carpet\).*Available:.*simulated"):
        load_driver("stage", "flying_carpet")


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Register:
    """Add entry points, ``name=value``, to those there are; modules can be written into ``tmp_path``."""
    monkeypatch.syspath_prepend(tmp_path)
    there = registry.entry_points(group=GROUP)

    def add(*points: tuple[str, str]) -> None:
        more = tuple(EntryPoint(name, value, GROUP) for name, value in points)
        monkeypatch.setattr(registry, "entry_points", lambda group: (*there, *more))

    return add


def unavailable() -> list[str]:
    """What a listing of the devices says of the drivers, without looking at the buses."""
    said: list[str] = []
    assert list(registry._drivers(said))
    return said


@pytest.mark.parametrize(
    ("value", "module", "words"),
    [
        (
            "typo_stage:MyStge",
            "class MyStage: pass",
            r"no MyStge in module typo_stage.*Correct the entry point",
        ),
        ("no_stage:Stage", "Stage = 3", r'"mine.stage" = "no_stage:Stage" is no driver of this kind'),
        ("cam_stage:C", "from drivers.camera import Camera as C", r"a class made from drivers.stage:Stage"),
        (
            "bad_import:S",
            "from math import nothing",
            r"ImportError: cannot import name 'nothing'.*mistake in",
        ),
        ("bad_name:S", "nothing", r"NameError: name 'nothing' is not defined.*mistake in"),
        ("bad_text:S", "def", r"SyntaxError.*mistake in"),
        ("no_module_at_all:S", None, r"No module named 'no_module_at_all'.*Correct"),
        ("needs_more:S", "import serial_of_mars.x", r"Install serial_of_mars \(pip"),
        ("needs_usb:S", "raise ModuleNotFoundError('No usb', name='usb.core')", r"Install pyusb \(pip"),
    ],
)
def test_a_broken_entry_point_is_refused_in_words(
    register: Register, tmp_path: Path, value: str, module: str | None, words: str
) -> None:
    if module is not None:
        (tmp_path / f"{value.partition(':')[0]}.py").write_text(module)
    register(("mine.stage", value))
    with pytest.raises(DeviceError, match=words) as raised:
        load_driver("stage", "mine")
    assert "stage (mine)" in str(raised.value)
    assert any("stage (mine)" in sentence for sentence in unavailable())
    bench = tmp_path / "bench.toml"
    bench.write_text('[camera]\ndriver = "simulated"\n[stage]\ndriver = "mine"\n')
    with pytest.raises(ConfigError, match=r":4: \[stage\] driver"):
        load_config(bench)


def test_a_name_that_is_taken_twice_is_refused_with_both(register: Register) -> None:
    register(("grbl.stage", "my_stage:MyStage"))
    with pytest.raises(
        DeviceError, match=r"drivers.grbl.stage:GrblStage.*and by.*my_stage:MyStage.*uninstall"
    ):
        load_driver("stage", "grbl")
    (said,) = registration_mistakes()
    assert said.startswith("Driver grbl.stage is registered by")


def test_an_entry_that_a_package_lists_twice_is_one(register: Register) -> None:
    register(("my.stage", "drivers.grbl.stage:GrblStage"), ("my.stage", "drivers.grbl.stage:GrblStage"))
    assert load_driver("stage", "my").__name__ == "GrblStage"
    assert registration_mistakes() == ()


@pytest.mark.parametrize("name", ["my_stage", "my_stage.stages", ".stage", "stage"])
def test_an_entry_point_of_another_form_is_said(register: Register, tmp_path: Path, name: str) -> None:
    register((name, "my_stage:MyStage"))
    (said,) = registration_mistakes()
    assert said.startswith(
        f'Entry point "{name}" = "my_stage:MyStage" is no driver\'s: it must be called NAME.KIND'
    )
    assert said in unavailable()
    assert "" not in driver_names("stage")
    with pytest.raises(DeviceError, match=r"must be called NAME\.KIND"):
        load_driver("stage", "my_stage")
    bench = tmp_path / "bench.toml"
    bench.write_text('[camera]\ndriver = "simulated"\n[stage]\ndriver = "my_stage"\n')
    with pytest.raises(ConfigError, match=r"must be called NAME\.KIND"):
        load_config(bench)


def test_the_entry_points_of_this_installation_are_sound() -> None:
    assert registration_mistakes() == ()


def test_a_package_that_is_installed_meanwhile_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    for number, name in enumerate(("first", "second")):
        assert name not in driver_names("stage")
        package = tmp_path / f"{name}-1.dist-info"
        package.mkdir()
        (package / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
        (package / "entry_points.txt").write_text(f"[{GROUP}]\n{name}.stage = drivers.grbl.stage:GrblStage\n")
        os.utime(tmp_path, ns=(number + 1, number + 1))  # a clock's coarseness is not what is tested
        assert name in driver_names("stage")
