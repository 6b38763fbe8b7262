"""``diffuserbench serve``: its token, what it says, and its end."""

from __future__ import annotations

import re
import threading
import urllib.request
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason='pip install "diffuserbench[remote]"')

from instrument.bench.config_file import parse_config
from instrument.cli import serve
from instrument.cli.serve import ServeOptions
from instrument.files.errors import BenchError, FileError
from tests.drivers.test_remote import BENCH

CONFIG = parse_config(BENCH, None)


def test_a_token_is_made_once_and_for_its_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    file, token = serve._token(None)
    assert file == tmp_path / "diffuserbench" / "token"
    assert file.stat().st_mode & 0o777 == 0o600
    assert len(token) >= 32
    assert serve._token(file) == (file, token)
    assert not capsys.readouterr().err
    file.chmod(0o644)
    serve._token(file)
    assert "Other users of this computer can read" in capsys.readouterr().err
    for wrong in ("short", "two words of which none is a token", ""):
        file.write_text(wrong)
        with pytest.raises(FileError, match="holds no token"):
            serve._token(file)
    with pytest.raises(FileError, match="cannot hold the token"):
        serve._token(file / "below")


def test_it_says_what_answers_where_it_serves_and_how_to_use_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    class Meanwhile(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            """Stand for the time until Ctrl-C."""
            said = capsys.readouterr()
            found = re.search(r"Page:  (http://127\.0\.0\.1:\d+)/#(\S+)", said.out)
            assert found is not None
            assert found[2] == (tmp_path / "token").read_text().strip()
            assert said.out.count('driver = "remote"') == 4
            assert "camera: diffuserbench Tiny" in said.out
            with urllib.request.urlopen(found[1]) as page:
                assert "default-src 'self'" in page.headers["Content-Security-Policy"]
            asked.append(1)
            raise KeyboardInterrupt

    monkeypatch.setattr(serve, "load_and_say", lambda _: CONFIG)
    monkeypatch.setattr(serve, "threading", type("threading", (), {"Event": Meanwhile}))
    options = ServeOptions(port=0, token_file=tmp_path / "token")
    with pytest.raises(KeyboardInterrupt):
        serve.serve(options)
    assert asked


def test_an_address_that_is_taken_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import socket

    monkeypatch.setattr(serve, "load_and_say", lambda _: CONFIG)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        options: Any = ServeOptions(port=taken.getsockname()[1], token_file=tmp_path / "token")
        with pytest.raises(BenchError, match=r"Nothing can be served at 127.0.0.1, port \d+: .* --port"):
            serve.serve(options)


def test_a_network_that_anybody_may_read_is_warned_of(capsys: pytest.CaptureFixture[str]) -> None:
    serve._introduce(CONFIG, "http://0.0.0.0:8470", Path("token"), "x", "0.0.0.0")
    said = capsys.readouterr()
    assert "is not encrypted" in said.err
    assert "ssh -N -L 8470:127.0.0.1:8470" in said.err
    assert "0.0.0.0" not in said.out
