"""Reading ``bench.toml``: checked whole, every mistake with its line and what would be right."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from drivers.device import Device, FoundDevice, SharedPart
from drivers.errors import DeviceError
from drivers.registry.registry import driver_names, load_driver, registration_mistakes
from instrument.bench.config import (
    DEVICE_TABLES,
    PLAIN_TABLES,
    BenchConfig,
    BenchTable,
    DeviceConfig,
    Kind,
    SharedConfig,
    Table,
)
from instrument.bench.config_mistakes import Mistakes, key_lines, nearest, nearest_name
from instrument.files.atomic import protect, write_text
from instrument.files.errors import BenchError, ConfigError, ConfigProblem, FileError
from instrument.files.reading import parse_toml, read_bytes

DEFAULT_NAME = "bench.toml"
BUILT_IN = "built-in bench.toml"

_Model = TypeVar("_Model", bound=BaseModel)


TEMPLATES: Mapping[str, tuple[str, str]] = {
    "default": ("camera behind a diffuser", ""),
    "display": ("holographic display", "--display"),
    "led_microscope": ("LED array microscope", "--microscope"),
    "screen": ("camera before a monitor", "--screen"),
}
"""The simulated benches: what each is, and how ``diffuserbench new`` is asked for it."""


def template(name: str = "default") -> str:
    """Return a commented simulated bench, one of :data:`TEMPLATES`."""
    return resources.files("instrument.bench").joinpath(f"{name}_bench.toml").read_text("utf-8")


def no_bench(folder: Path) -> BenchConfig:
    """Return a bench without devices, for work on files alone; results go into ``folder``/runs."""
    tables: dict[str, Any] = {name: model() for name, model in PLAIN_TABLES.items()}
    tables["bench"] = BenchTable(name="no bench", data_folder=str(folder / "runs"))
    return BenchConfig(path=None, text="", devices={}, **tables)


def tried_bench(name: str, folder: Path) -> BenchConfig:
    """Return a simulated bench, one of :data:`TEMPLATES`, in a folder of its own, written if need be.

    Raises FileError when it cannot be written or read; ConfigError when it was changed and is wrong now.
    """
    file = folder / f"simulated-{name.replace('_', '-')}" / DEFAULT_NAME
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, template(name))
    return load_config(file)


def connected_bench(devices: Iterable[FoundDevice], name: str) -> str:
    """Return the ``bench.toml`` that uses devices which are connected, light and stage by hand as needed.

    Raises BenchError where no driver knows one of them, two are of the same kind, or none is a camera.
    """
    tables: dict[str, str] = {}
    for device in devices:
        lines, kind = device.bench_lines(), str(device.kind)
        if not lines:
            raise BenchError(f"{device.description} at {device.address}: no driver knows it.")
        if kind in tables:
            raise BenchError(f"Two devices are a {kind}: a bench has one. Choose one of them.")
        tables[kind] = lines
    if "camera" not in tables:
        raise BenchError("No camera is chosen: a bench needs one.")
    bench = f'[bench]\nname = {json.dumps(name)}\ndata_folder = "runs"'
    scene = '[scene]\ncontrol = "operator"          # a person is asked to light and darken the scene'
    head = "# All keys of all drivers: docs/reference/bench-toml.md"
    return "\n\n".join([head, bench, *(tables[kind] for kind in DEVICE_TABLES if kind in tables), scene, ""])


def other_bench_for(config: BenchConfig, kinds: Iterable[str], name: str) -> str | None:
    """Say that a simulated bench is not the one that something can be tried on, and how to get that one.

    The sentence is for the terminal; errors and parameters as :func:`not_tried_on`. None where it is.
    """
    wrong = not_tried_on(config, kinds, name)
    if not wrong:
        return None
    what, flag = TEMPLATES[name]
    write = " ".join(filter(None, ("diffuserbench new", f"{name}.toml", flag)))
    return (
        f"This cannot be tried on {config.label}, whose {' and '.join(wrong)} would see nothing of it: it "
        f"takes a simulated {what}. Write one with {write}, then give the same command --bench {name}.toml."
    )


@cache
def _tables(name: str) -> dict[str, Any]:
    return tomllib.loads(template(name))


def not_tried_on(config: BenchConfig, kinds: Iterable[str], name: str) -> list[str]:
    """Return the devices of a simulated bench that would see nothing of what is tried on another one.

    Parameters
    ----------
    config : BenchConfig
    kinds : iterable of str
        The devices that it takes.
    name : str
        The bench that it can be tried on, of :data:`TEMPLATES`.

    Returns
    -------
    list of str
        Empty where the devices are that bench's, or some of them are no simulated ones.
    """
    present = {kind: device.driver_name for kind, device in config.devices.items() if kind in set(kinds)}
    tables = _tables(name)
    wrong: list[str] = [k for k, driver in present.items() if tables.get(k, {}).get("driver") != driver]
    return wrong if all(driver.startswith("simulated") for driver in present.values()) else []


def load_config(path: Path | str | None = None) -> BenchConfig:
    """Read and check a bench configuration without touching any device.

    Without a path it is ``bench.toml`` in the working folder if there is one, otherwise the embedded default,
    which is the simulated bench (:attr:`BenchConfig.path` is then None).

    Raises FileError when the file cannot be read; ConfigError with every mistake that the file contains.
    """
    if path is None:
        if not Path(DEFAULT_NAME).exists():
            return parse_config(template(), None)
        path = DEFAULT_NAME
    path = Path(path)
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except FileNotFoundError:
        raise FileError(path, "there is no such file.", f"Write one with: diffuserbench new {path}") from None
    except UnicodeDecodeError as error:
        raise FileError(path, f"is not UTF-8 text (byte {error.start}); a bench.toml is expected.") from None
    config = parse_config(text, path)
    mask = config.display.mask_file
    protect(path, *([path.parent / mask] if mask else []))
    return config


def parse_config(text: str, path: Path | None) -> BenchConfig:
    """Check a configuration given as text; ``path`` is the file it came from, if any. See ``load_config``."""
    source = path if path is not None else BUILT_IN
    try:
        tables = parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(source, [_toml_problem(error, text)]) from None
    except ValueError as error:
        raise ConfigError(source, [ConfigProblem(None, "the file", f"{error}.")]) from None
    reader = _Reader(tables, Mistakes(key_lines(text)))
    plain = {name: reader.plain_table(name, model) for name, model in PLAIN_TABLES.items()}
    devices = {kind: device for kind in DEVICE_TABLES if (device := reader.device(kind))}
    reader.refuse_wire_from_nowhere(plain["trigger"])
    shared = reader.shared_parts()
    reader.refuse_unknown_tables()
    if reader.mistakes:
        raise ConfigError(source, reader.mistakes.problems)
    return BenchConfig(path=path, text=text, devices=devices, shared=shared, **plain)  # type: ignore[arg-type]


class _Reader:
    """Goes through the tables once and collects mistakes; what it returns is whole only without any."""

    def __init__(self, tables: dict[str, Any], mistakes: Mistakes) -> None:
        self._tables = tables
        self.mistakes = mistakes
        self._known = [*PLAIN_TABLES, *DEVICE_TABLES]
        self._a_driver_is_unknown = False
        self._shared: dict[str, type[SharedPart]] = {}

    def plain_table(self, name: str, model: type[Table]) -> Table | None:
        table = self._table(name)
        return None if table is None else self._validate(model, table, (name,), model.model_fields)

    def device(self, kind: Kind) -> DeviceConfig | None:
        if kind not in self._tables:
            if kind == "camera":
                self.mistakes.add((), "[camera]", "this table is missing; a bench needs a camera.")
            return None
        table = self._table(kind)
        if table is None:
            return None
        name = table.pop("driver", None)
        common = DEVICE_TABLES[kind]
        settings_table = {key: table[key] for key in table if key in common.model_fields}
        own = {key: value for key, value in table.items() if key not in common.model_fields}
        driver = self._driver(kind, name)
        if driver is None:  # the keys that every driver of this kind has can be checked all the same
            self._a_driver_is_unknown = True
            self._validate(common, settings_table, (kind,), common.model_fields)
            return None
        if driver.Shared is not None:
            self._shared[driver.Shared.table] = driver.Shared
        known = ["driver", *common.model_fields, *driver.Options.model_fields]
        settings = self._validate(common, settings_table, (kind,), known)
        options = self._validate(driver.Options, own, (kind,), known)
        if settings is None or options is None:
            return None
        return DeviceConfig(kind, str(name), driver, options, settings)

    def refuse_wire_from_nowhere(self, trigger: object) -> None:
        sent_by = getattr(trigger, "sent_by", None)
        if sent_by is not None and sent_by not in self._tables:
            self.mistakes.add(
                ("trigger", "sent_by"),
                "[trigger] sent_by",
                f"this bench has no [{sent_by}] that sends pulses.",
            )

    def _driver(self, kind: Kind, name: object) -> type[Device] | None:
        """Return the driver; of a misspelt name the nearest one, so that the table's other mistakes show."""
        where, names = f"[{kind}] driver", driver_names(kind)
        available = f"Drivers there are: {', '.join(names) or 'none'}."
        if name is None:
            self.mistakes.add((kind,), where, f"this key is missing. {available}")
            return None
        if not isinstance(name, str):
            self.mistakes.add((kind, "driver"), where, f"must be a text, not {name!r}. {available}")
            return None
        meant = name
        if name not in names:
            hint = nearest(name, names)
            lost = "".join(f" {sentence}" for sentence in registration_mistakes())
            self.mistakes.add(
                (kind, "driver"), where, f"no driver is called {name!r}.{hint} {available}{lost}"
            )
            close = nearest_name(name, names)
            if close is None:
                return None
            meant = close
        try:
            return load_driver(kind, meant)
        except DeviceError as error:
            self.mistakes.add((kind, "driver"), where, f"{error.problem} {error.remedy}".strip())
            return None

    def shared_parts(self) -> dict[str, SharedConfig]:
        shared = {}
        for name, part in self._shared.items():
            self._known.append(name)
            table = self._table(name)
            if table is None:
                continue
            options = self._validate(part.Options, table, (name,), part.Options.model_fields)
            if options is not None:
                shared[name] = SharedConfig(part, options)
        return shared

    def refuse_unknown_tables(self) -> None:
        for name, value in self._tables.items():
            if name in self._known:
                continue
            if not isinstance(value, dict):
                self.mistakes.add(
                    (name,), name, f"this key stands outside every table. Tables: {', '.join(self._known)}."
                )
            elif (hint := nearest(name, self._known)) or not self._a_driver_is_unknown:
                # Without a near name it may be the table of the driver that is misspelt elsewhere.
                self.mistakes.add(
                    (name,),
                    f"[{name}]",
                    "no such table, and no driver named in this file uses one."
                    f"{hint} Tables: {', '.join(self._known)}.",
                )

    def _table(self, name: str) -> dict[str, Any] | None:
        table = self._tables.get(name, {})
        if isinstance(table, dict):
            return dict(table)
        self.mistakes.add((name,), name, f"must be a table, [{name}], not {table!r}.")
        return None

    def _validate(
        self, model: type[_Model], table: Mapping[str, Any], path: tuple[str, ...], known: Iterable[str]
    ) -> _Model | None:
        try:
            # Strict JSON mode: no text taken for a number, yet arrays may be tuples and text may be enums.
            return model.model_validate_json(json.dumps(table, default=str), strict=True)
        except ValidationError as error:
            self.mistakes.add_all(error, model, path, tuple(known), table)
            return None


def _toml_problem(error: tomllib.TOMLDecodeError, text: str) -> ConfigProblem:
    message = str(error)
    found = re.search(r"\(at line (\d+), column (\d+)\)", message)
    number = int(found.group(1)) if found else text.count("\n") + 1
    rows = text.split("\n")
    row = rows[number - 1].strip() if number <= len(rows) else ""
    what = re.sub(r" \(at .*\)$", "", message)
    return ConfigProblem(
        number,
        "broken TOML",
        f"{what}{f': {row!r}' if row else ''}. Until this is put right nothing else can be checked.",
    )
