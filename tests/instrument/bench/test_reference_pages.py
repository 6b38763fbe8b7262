"""The reference pages say what the program does now."""

from __future__ import annotations

import re
from pathlib import Path

from drivers.registry.registry import KINDS, driver_names, load_driver
from instrument.bench.config import DEVICE_TABLES, PLAIN_TABLES
from instrument.bench.config_file import parse_config, template
from instrument.bench.config_reference import reference
from instrument.cli import COMMANDS
from instrument.cli.reference import manual
from instrument.cli.reference import page as options_page

DOCS = Path(__file__).parents[3] / "docs" / "reference"


def test_the_configuration_reference_is_what_the_models_say() -> None:
    """Should it fail on a driver missing here: the installation is older than pyproject.toml (run make)."""
    page = (DOCS / "bench-toml.md").read_text("utf-8")
    assert page == reference(), (
        "renew it: python -m instrument.bench.config_reference > docs/reference/bench-toml.md"
    )


def test_the_reference_of_options_is_what_they_are_declared_to_be() -> None:
    page = (DOCS / "options.md").read_text("utf-8")
    assert page == options_page(), "renew it: python -m instrument.cli.reference > docs/reference/options.md"


def test_the_manual_page_has_every_command() -> None:
    page = (DOCS.parent / "diffuserbench.1").read_text("utf-8")
    assert page == manual(), "renew it: python -m instrument.cli.reference --man > docs/diffuserbench.1"


def test_no_option_is_without_words() -> None:
    rows = [line for line in options_page().splitlines() if line.startswith("| `")]
    assert len(rows) > 80
    assert [row for row in rows if row.endswith("|  |")] == []


def test_the_configuration_reference_explains_every_key() -> None:
    rows = [line for line in reference().splitlines() if line.startswith("| `")]
    assert len(rows) > 40
    assert [row for row in rows if row.endswith("|  |")] == []


def test_the_default_configuration_is_the_simulated_bench() -> None:
    config = parse_config(template(), None)
    assert {device.driver_name for device in config.devices.values()} == {"simulated"}
    assert set(config.devices) == set(DEVICE_TABLES)


def test_the_default_configuration_shows_every_key() -> None:
    text, config = template(), parse_config(template(), None)
    models = [*PLAIN_TABLES.values(), *DEVICE_TABLES.values()]
    models += [device.driver.Options for device in config.devices.values()]  # type: ignore[list-item]
    models += [shared.part.Options for shared in config.shared.values()]  # type: ignore[list-item]
    missing = [key for model in models for key in model.model_fields if f"{key} =" not in text]
    assert not missing


def test_every_commented_key_of_the_default_configuration_is_understood() -> None:
    """A line that starts ``# key = value`` may lose its ``# ``, one at a time or all together."""
    commented = re.compile(r"^# (?=\w+ = )", re.MULTILINE)
    text = template()
    assert len(commented.findall(text)) > 10
    parse_config(commented.sub("", text), None)
    for match in commented.finditer(text):
        parse_config(text[: match.start()] + text[match.end() :], None)


def test_the_overview_of_commands_is_complete() -> None:
    page = (DOCS / "command-line.md").read_text("utf-8")
    assert [name for name in COMMANDS if f"diffuserbench {name}" not in page] == []


def test_every_driver_of_this_project_is_in_the_table_of_drivers() -> None:
    page = (DOCS / "drivers.md").read_text("utf-8")
    own = [
        f"{name}.{kind}"
        for kind in KINDS
        for name in driver_names(kind)
        if load_driver(kind, name).__module__.startswith("drivers.")
    ]
    assert len(own) > 10
    missing = [driver for driver in own if f"`{driver}`" not in page]
    assert missing == [], "add a row to docs/reference/drivers.md"


def test_every_link_of_the_table_of_drivers_leads_somewhere() -> None:
    page = (DOCS / "drivers.md").read_text("utf-8")
    links = re.findall(r"\]\(([^)#]+)\)", page)
    assert [link for link in links if not (DOCS / link).exists()] == []
