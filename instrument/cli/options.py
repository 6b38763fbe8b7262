"""Command functions take options objects: their flags, help and refusals come from the declarations.

A command is a function whose parameters are options classes (frozen dataclasses with declared fields, see
:mod:`recon.base.declare`), :class:`~instrument.tasks.task.Given`, and as many ordinary parameters of typer as
it needs::

    @app.command()
    def snap(options: SnapOptions, bench: BenchOption = None) -> None: ...
"""

from __future__ import annotations

import inspect
import shlex
import typing
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand

from instrument.files.errors import BenchError
from instrument.tasks.task import Given, guarded, part_of
from recon.base.declare import OTHER_NAMES, RARE, Option
from recon.base.option_text import help_text, metavar, read
from recon.errors import InputError

# What typer raises for wrong options; its public subclass is the stable way to name it.
USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]
_MAIN = "Options"
_WORDS = "words that were typed"
_WIDEST_FLAG = 30
_MANY = 30
"""Options, above which help does without empty lines between the groups."""


class GroupedCommand(TyperCommand):
    """A command whose help shows the options under their groups' headings, what is rare last."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Remember the flags as they were typed: of several names of an option messages say that one.

        ``help`` as the only word asks for help, as it does before a command, unless a file has that name.
        """
        if args == ["help"] and not Path("help").exists():
            args = ["--help"]
        ctx.meta[_WORDS] = {word.partition("=")[0] for word in args}
        typed = list(args)
        try:
            return super().parse_args(ctx, args)
        except USAGE_ERROR as error:
            message = getattr(error, "message", "")
            if "unexpected extra argument" in message and (meant := self._meant(ctx, typed)):
                error.message = f"{message}. Did you mean {meant}?"  # type: ignore[attr-defined]
            if unknown := getattr(error, "option_name", ""):
                self._suggest(error, unknown)
            missing = getattr(error, "param", None)
            if not message and getattr(missing, "param_type_name", "") == "argument":
                error.message = self._wanted(missing)  # type: ignore[attr-defined]
            raise

    def _suggest(self, error: Any, unknown: str) -> None:
        """Name the option that is meant: in other capitals, by its name in Python or in other programs."""
        meant = unknown.lstrip("-").casefold().replace("_", "-")
        called = {meant, OTHER_NAMES.get(meant, meant)}
        for option in self.params:
            flags = [flag for flag in option.opts if flag.startswith("--")]
            known = [str(option.name).rpartition("__")[2].replace("_", "-"), *(flag[2:] for flag in flags)]
            if flags and called & set(known):
                error.possibilities = [flags[0]]

    def _wanted(self, argument: Any) -> str:
        """Say what an argument is that was not given, and how the command is typed."""
        said = str(argument.help or "").partition("  [")[0].strip()
        words = (line.strip() for line in (self.epilog or "").splitlines())
        example = next((line for line in words if line.startswith("diffuserbench ")), "")
        return " ".join(filter(None, (said, f"For example: {example}" if example else "")))

    def _meant(self, ctx: typer.Context, typed: list[str]) -> str:
        """Guess the options that files without one were meant for; empty where there are none."""
        options = [param for param in self.get_params(ctx) if param.param_type_name == "option"]
        takes_value = {
            f for o in options if not getattr(o, "is_flag", False) for f in (*o.opts, *o.secondary_opts)
        }
        flags = [flag for o in options for flag in o.opts if flag.startswith("--") and flag in takes_value]
        files = [
            w
            for w, before in zip(typed, ["", *typed], strict=False)
            if w[:1] != "-" and before not in takes_value
        ]
        meant: list[str] = []
        for file in map(Path, files):
            if len(meant) % 2:  # after an option that lacked its dashes
                meant.append(str(file))
                continue
            if f"--{file}" in flags and not file.exists():
                meant.append(f"--{file}")
                continue
            named = [flag for flag in flags if flag[2:] in file.name.lower() and flag != "--out"]
            kept = (file / "calibration.json", file / "calibration" / "calibration.json")  # of a run, too
            if "--calibration" in flags and any(one.exists() for one in kept):
                named = ["--calibration"]
            if file.suffix == ".toml" and "--bench" in flags:
                named = ["--bench"]
            if not file.exists():
                named = ["--out"]
            flag = named[0] if named else "--image"
            if flag not in flags:
                return ""
            meant += [flag, str(file)]
        return shlex.join(meant)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options, a definition list a group; close together where there are many."""
        declared: Mapping[str, Option] = getattr(self.callback, "declared", {})
        arguments: list[tuple[str, str]] = []
        groups: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            o = declared.get(param.name)
            row = param.get_help_record(ctx) if o is None else _row(o)
            if row is None:
                continue
            if param.param_type_name == "argument":
                arguments.append(row)
            else:
                groups.setdefault((o.declaration.group if o is not None else "") or _MAIN, []).append(row)
        groups = {name: groups[name] for name in sorted(groups, key=lambda name: name == RARE)}
        if len(groups) > 1 and len(groups[_MAIN]) == 1:  # --help alone
            alone = groups.pop(_MAIN)
            groups[next(reversed(groups))] += alone
        shown = [(heading, rows) for heading, rows in [("Arguments", arguments), *groups.items()] if rows]
        for number, (heading, rows) in enumerate(shown):
            if len(declared) <= _MANY or number == 0:
                formatter.write_paragraph()
            formatter.write_heading(heading)
            with formatter.indentation():
                formatter.write_dl(rows, col_max=_WIDEST_FLAG)


def _row(o: Option) -> tuple[str, str]:
    """Return flags and help; of the long flags the first is shown, the others are old names."""
    if o.declaration.positional:
        return metavar(o), help_text(o, choices=bool(o.words))
    short = [flag for flag in o.flags if not flag.startswith("--")]
    names = ", ".join([*short, next(flag for flag in o.flags if flag.startswith("--"))])
    if bool in o.kinds:
        return names, help_text(o)
    if len(left := f"{names} {metavar(o)}") <= _WIDEST_FLAG or o.declaration.metavar:
        return left, help_text(o)
    return f"{names} NAME", help_text(o, choices=True)


def flat(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function for typer: each declared field of its options objects is a parameter of its own.

    A function's own ``before_mistakes`` is called with the other values where an option is wrong or missing,
    and may raise what is to be said instead.
    """
    before_mistakes: Callable[[Mapping[str, Any]], None] | None = getattr(function, "before_mistakes", None)
    hints = typing.get_type_hints(function, include_extras=True)
    objects: dict[str, tuple[type, dict[str, Option]]] = {}
    declared: dict[str, Option] = {}
    parameters: list[inspect.Parameter] = []
    wants_given = ""
    for parameter in inspect.signature(function).parameters.values():
        hint = hints[parameter.name]
        if hint is Given:
            wants_given = parameter.name
        elif (found := part_of(hint)) is not None:
            cls, options = found
            objects[parameter.name] = (
                cls,
                {f"{parameter.name}__{o.name}": o for o in options if o.flags or o.declaration.positional},
            )
            declared |= objects[parameter.name][1]
            parameters += [_parameter(key, o) for key, o in objects[parameter.name][1].items()]
        else:
            parameters.append(parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY))

    def run(context: typer.Context, **values: Any) -> None:
        typed = {key: values.pop(key) for key in declared}
        given = {key: value for key, value in typed.items() if value is not None and value != []}
        named = {
            key: _as_named(o, context.meta[_WORDS]) if key in given else o for key, o in declared.items()
        }
        try:
            read_values = _read(named, given)
        except BenchError:
            if before_mistakes is not None:
                before_mistakes(values)
            raise
        for name, (cls, keys) in objects.items():
            values[name] = cls(**{o.name: read_values[key] for key, o in keys.items() if key in read_values})
        if wants_given:
            values[wants_given] = Given(
                {named[key].name: named[key] for key in given},
                {named[key].name: _as_typed(named[key], value) for key, value in given.items()},
            )
        with guarded(values):
            function(**values)

    run.__name__, run.__doc__, run.__module__ = function.__name__, function.__doc__, function.__module__
    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    parameters.insert(0, context)
    run.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": None}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.declared = declared  # type: ignore[attr-defined]
    run.options_classes = [cls for cls, _ in objects.values()]  # type: ignore[attr-defined]
    return run


def _as_named(o: Option, words: Container[str]) -> Option:
    """Return an option with that of its flags first that was typed."""
    if (typed := next((f for f in o.flags if f.startswith("--") and f in words), o.flag)) == o.flag:
        return o
    flags = (typed, *(flag for flag in o.flags if flag != typed))
    return replace(o, declaration=replace(o.declaration, flags=flags))


def _as_typed(o: Option, value: Any) -> str:
    switch = next((flag for flag in o.flags if "/" in flag), "")
    return switch.partition("/")[2] if value is False else o.flag


def _parameter(key: str, o: Option) -> inspect.Parameter:
    """Return a parameter that is None unless it was typed; text is read later, with all mistakes at once."""
    kind: Any = str
    if bool in o.kinds:
        kind = bool
    elif o.item is not None or o.declaration.parse_all is not None:
        kind = list[str]
    else:
        in_one = o.declaration.parse is not None or "," in o.declaration.metavar
        several = [k for k in o.kinds if typing.get_origin(k) is tuple and not in_one]
        kind = tuple[tuple(str for _ in typing.get_args(several[0]))] if several else kind  # type: ignore[misc]
    how: Any = typer.Option(*o.flags, show_default=False, metavar=metavar(o))
    default: Any = None
    if o.declaration.positional:
        how = typer.Argument(show_default=False, metavar=metavar(o), help=o.declaration.help)
        default = inspect.Parameter.empty if o.is_required else None
    wanted: Any = kind if default is inspect.Parameter.empty else kind | None
    annotation = typing.Annotated[wanted, how]
    return inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _read(declared: Mapping[str, Option], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of what was typed.

    Raises BenchError with all mistakes at once, each with its flag.
    """
    values: dict[str, Any] = {}
    wrong: list[str] = []
    for key, text in given.items():
        o = declared[key]
        try:
            value = text if isinstance(text, bool) else read(o, text)
        except (InputError, BenchError) as error:
            wrong.append(str(error))
            continue
        values[key] = value
        if mistake := o.mistake(value, typed=True):
            wrong.append(mistake)
    wrong += [_missing(o) for key, o in declared.items() if o.is_required and key not in given]
    if wrong:
        raise BenchError("\n".join(wrong))
    return values


def _missing(o: Option) -> str:
    """Say that an option must be given, and what it is: who lacks it may not know."""
    said = o.declaration
    words, unit = said.help.partition(". ")[0].rstrip("."), said.shown_unit or said.unit
    in_unit = f", in {unit}" if unit else ""
    if not words[1:2].isupper():  # TIFF, PSFs
        words = f"{words[:1].lower()}{words[1:]}"
    return f"{o.flag} must be given" + (f": {words}{in_unit}." if words else ".")
