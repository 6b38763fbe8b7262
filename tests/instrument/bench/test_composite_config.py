"""Mistakes in the parts of a composite stage are said as those of any other table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from instrument.bench.config_file import parse_config
from instrument.files.errors import ConfigError

TEXT = """\
[camera]
driver = "simulated"
[stage]
driver = "composite"
[stage.parts.xyz]
driver = "zaber"
prot = "/dev/ttyUSB0"
[stage.parts.xyz.axes.x_um]
microsteps_um = 0.5
[stage.parts.tilt]
driver = "zabr"
[stage.parts.rest]
driver = "zaber"
port = 3
axes = { x_um = { microstep_um = -1.0 } }
"""

EXPECTED = [
    r":5: \[stage\] parts\.xyz\.port: this key is missing\. Serial port",
    r":7: \[stage\] parts\.xyz\.prot: there is no such key\. Did you mean 'port'\? Keys here: driver, port",
    r":9: \[stage\] parts\.xyz\.axes\.x_um\.microsteps_um: .* mean 'microstep_um'\? Keys here: reverse",
    r":11: \[stage\] parts\.tilt\.driver: must be one of .*zaber.*, not 'zabr'\. Driver of this part",
    r":14: \[stage\] parts\.rest\.port: must be a text, not 3\. Serial port",
    r":15: \[stage\] parts\.rest\.axes\.x_um\.microstep_um: must be greater than 0, not -1\.0\. Size of a",
]


def test_every_mistake_of_every_part_has_its_line_and_its_keys() -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(TEXT, Path("bench.toml"))
    found = str(caught.value).splitlines()[1:]
    for pattern in EXPECTED:
        assert any(re.search(pattern, line) for line in found), (pattern, found)
    assert len(found) == len(EXPECTED)


def test_parts_that_contradict_each_other_do_not_print_the_whole_file() -> None:
    text = TEXT.splitlines()[:4]
    for name in ("one", "two"):
        text += [f"[stage.parts.{name}]", 'driver = "zaber"', 'port = "/dev/ttyUSB0"']
        text += ["axes = { x_um = { microstep_um = 1.0 } }"]
    with pytest.raises(ConfigError, match=r"parts one and two both use port /dev/ttyUSB0; .*axes\.$"):
        parse_config("\n".join(text), Path("bench.toml"))
