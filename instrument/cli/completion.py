"""``diffuserbench completion``: what a shell needs to complete commands, options and their words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import typer

from instrument.cli.app import App, examples
from instrument.files.errors import BenchError

app = App()

SHELLS = ("bash", "zsh", "fish")

_SCRIPT = """\
# Completions of diffuserbench for bash and zsh.
[ -n "$ZSH_VERSION" ] && autoload -U +X compinit bashcompinit && compinit && bashcompinit
typeset -gA _diffuserbench_words _diffuserbench_values
{tables}
_diffuserbench() {{
  local cur="${{COMP_WORDS[COMP_CWORD]}}" prev="${{COMP_WORDS[COMP_CWORD-1]}}" key="" place word
  for ((place = 1; place < COMP_CWORD; place++)); do
    word="${{key:+$key-}}${{COMP_WORDS[place]}}"
    [ -n "${{_diffuserbench_words[$word]}}" ] && key="$word"
  done
  local words="${{_diffuserbench_words[${{key:-all}}]}}" values="${{_diffuserbench_values[$key$prev]}}"
  if [ -n "$values" ]; then
    COMPREPLY=($(compgen -W "$values" -- "$cur"))
  elif [[ "$cur" == -* || "$words" != -* ]]; then
    COMPREPLY=($(compgen -W "$words" -- "$cur"))
  else
    COMPREPLY=($(compgen -f -- "$cur"))
  fi
}}
complete -o filenames -F _diffuserbench diffuserbench
"""
_FISH = """\
# Completions of diffuserbench for fish.
set -g __diffuserbench_keys {keys}
function __diffuserbench_at
  set -l key all
  for word in (commandline -opc)[2..-1]
    set -l below $key-$word
    test $key = all; and set below $word
    contains -- $below $__diffuserbench_keys; and set key $below
  end
  test $key = $argv[1]
end
{lines}
"""


@app.command(
    epilog=examples(
        "diffuserbench completion > ~/.local/share/bash-completion/completions/diffuserbench",
        'eval "$(diffuserbench completion)"          for this shell, bash or zsh',
        "diffuserbench completion fish > ~/.config/fish/completions/diffuserbench.fish",
    )
)
def completion(
    shell: Annotated[
        str, typer.Argument(help="bash, zsh (both take the same lines) or fish.", show_default=False)
    ] = "bash",
) -> None:
    """Print completions of commands, options and their words for a shell, plug-ins' among them."""
    if shell not in SHELLS:
        raise BenchError(f"There are no completions for {shell}; there are for {', '.join(SHELLS)}.")
    typer.echo(script(shell), nl=False)


def script(shell: str = "bash") -> str:
    """Return the shell's lines."""
    from instrument.cli import COMMANDS

    below = {"all": list(COMMANDS)}
    options: dict[str, dict[str, Sequence[str] | None]] = {}
    """Of each command its options, with the words that one takes, none for a switch."""
    for name, command in COMMANDS.items():
        for key, parser in _parsers(name, typer.main.get_command(command.load())):
            declared: Mapping[str, Any] = getattr(parser.callback, "declared", {})
            below[key] = list(getattr(parser, "commands", ()))
            options[key] = {
                flag: None if getattr(param, "is_flag", False) else _words(declared, param.name)
                for param in parser.params
                for flag in (*param.opts, *param.secondary_opts)
                if flag[0] == "-"
            } | {"--help": None}
    if shell == "fish":
        return _FISH.format(keys=" ".join(options), lines="\n".join(_fish_lines(below, options)))
    tables = []
    for key, commands in below.items():
        words = [*commands, *(flag for flag in options.get(key, ()) if flag[:2] == "--")]
        tables.append(f"_diffuserbench_words[{key}]='{' '.join(words)}'")
    for key, flags in options.items():
        given = [(flag, " ".join(words)) for flag, words in flags.items() if words]
        tables += [f"_diffuserbench_values[{key}{flag}]='{words}'" for flag, words in given]
    return _SCRIPT.format(tables="\n".join(tables))


def _words(declared: Mapping[str, Any], name: str) -> Sequence[str]:
    return declared[name].words if name in declared else ()


def _fish_lines(
    below: Mapping[str, Sequence[str]], options: Mapping[str, Mapping[str, Sequence[str] | None]]
) -> Iterator[str]:
    for key, commands in below.items():
        line = f"complete -c diffuserbench -n '__diffuserbench_at {key}'"
        if commands:
            yield f"{line} -f -a '{' '.join(commands)}'"
        for flag, words in options.get(key, {}).items():
            taken = "" if words is None else f" -x -a '{' '.join(words)}'" if words else " -r"
            yield f"{line} {'-l' if flag[1] == '-' else '-s'} {flag.lstrip('-')}{taken}"


def _parsers(name: str, parser: Any) -> Iterator[tuple[str, Any]]:
    """Yield a command and its sub-commands, by their names with a dash between."""
    yield name, parser
    for sub, below in getattr(parser, "commands", {}).items():
        yield from _parsers(f"{name}-{sub}", below)
