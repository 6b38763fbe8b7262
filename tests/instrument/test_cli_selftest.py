"""``diffuserbench test``: finds an installation sound, and one that is not."""

from __future__ import annotations

import pytest

from instrument.cli import main, selftest
from recon.priors import PRIORS
from recon.priors.base import L1
from recon.priors.named import NamedPrior


def test_this_installation_works(capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["packages", "files", "cameras", "priors", "solvers"]
    assert main(["test", *quick]) == 0
    said = capsys.readouterr().out
    assert [line.split()[0] for line in said.splitlines()[1:-1]] == quick
    assert all(word in said for word in ("not installed:", "lowrank", "fista", "All of it works"))


class Halved(L1):
    """A prior whose prox is another's."""

    def prox(self, x, step):
        return super().prox(x, 3 * step)


def test_what_does_not_work_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["test", "cams"]) == 2
    assert "Parts: packages, files," in capsys.readouterr().err
    assert "tv" in PRIORS
    monkeypatch.setattr(PRIORS, "_foreign", dict(PRIORS._foreign))
    PRIORS.register(NamedPrior("halved", "Wrong.", Halved))
    monkeypatch.setattr(selftest, "LEAST_DB", 99.0)

    def no_module(_: object) -> str:
        raise ImportError("no such symbol")

    monkeypatch.setattr(selftest, "PARTS", {**selftest.PARTS, "files": no_module})
    assert main(["test", "priors", "solvers", "files"]) == 1
    said = capsys.readouterr()
    assert "BROKEN: halved: the prox costs" in said.out
    assert "BROKEN: admm" in said.out
    assert "BROKEN: ImportError: no such symbol" in said.out
    assert "Does not work: priors, solvers, files." in said.err
