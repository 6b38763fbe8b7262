"""Telling a reconstruction's verdict on the terminal."""

from __future__ import annotations

import typer

from recon.verdict.verdict import Verdict


def tell_verdict(verdict: Verdict | None) -> None:
    """Print the verdict, one sentence a line; nothing where none was asked for."""
    if verdict is None:
        return
    for index, sentence in enumerate(verdict.sentences):
        typer.echo(f"{'Verdict' if not index else '':<12}{sentence}")
