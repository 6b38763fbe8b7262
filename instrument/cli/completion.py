"""``diffuserbench completion``: what a shell needs to complete commands, options and their words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import typer

from instrument.cli.app import App, examples
from instrument.files.errors import BenchError

app = App()

SHELLS = ("bash", "zsh")

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


@app.command(
    epilog=examples(
        "diffuserbench completion > ~/.local/share/bash-completion/completions/diffuserbench",
        'eval "$(diffuserbench completion)"          for this shell',
    )
)
def completion(
    shell: Annotated[
        str, typer.Argument(help="bash or zsh: both take the same lines.", show_default=False)
    ] = "",
) -> None:
    """Print completions of commands, options and their words for bash and zsh, plug-ins' among them."""
    if shell not in ("", *SHELLS):
        raise BenchError(f"There are no completions for {shell}; there are for {' and '.join(SHELLS)}.")
    typer.echo(script(), nl=False)


def script() -> str:
    """Return the shell's lines."""
    from instrument.cli import COMMANDS

    words = {"all": " ".join(COMMANDS)}
    values: dict[str, str] = {}
    for name, command in COMMANDS.items():
        for key, parser in _parsers(name, typer.main.get_command(command.load())):
            declared: Mapping[str, Any] = getattr(parser.callback, "declared", {})
            flags = [
                (flag, param) for param in parser.params for flag in (*param.opts, *param.secondary_opts)
            ]
            words[key] = " ".join(
                [*getattr(parser, "commands", ()), *(f for f, _ in flags if f[:2] == "--"), "--help"]
            )
            for flag, param in flags:
                if param.name in declared and (said := declared[param.name].words):
                    values[key + flag] = " ".join(said)
    tables = [f"_diffuserbench_words[{key}]='{text}'" for key, text in words.items()]
    return _SCRIPT.format(
        tables="\n".join(tables + [f"_diffuserbench_values[{key}]='{text}'" for key, text in values.items()])
    )


def _parsers(name: str, parser: Any) -> Iterator[tuple[str, Any]]:
    """Yield a command and its sub-commands, by their names with a dash between."""
    yield name, parser
    for sub, below in getattr(parser, "commands", {}).items():
        yield from _parsers(f"{name}-{sub}", below)
