"""Tokens: their file, the command that changes it, the server that follows it."""

from __future__ import annotations

import argparse
import json
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from lodestream.errors import LodestreamError, NotFoundError, OptionError
from lodestream_server.access.tokens import SCOPES, TokenFile, Tokens
from lodestream_server.commands.token import register


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "keys" / "tokens.json"


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(["token", *arguments])
    code: int = args.run(args)
    return code


def test_only_the_hash_is_kept(path: Path) -> None:
    text, token = TokenFile(path).create("ci", ("write",))
    assert text.startswith("lode_")
    assert len(text) >= 48
    assert text not in path.read_text()
    assert text.removeprefix("lode_") not in path.read_text()
    assert TokenFile(path).load() == (token,)
    assert path.stat().st_mode & 0o777 == 0o600
    assert list(path.parent.iterdir()) == [path]


def test_a_scope_includes_those_before_it(path: Path) -> None:
    allowed = {scope: TokenFile(path).create(scope, (scope,))[1] for scope in SCOPES}
    assert [[allowed[given].allows(wanted) for wanted in SCOPES] for given in SCOPES] == [
        [True, False, False],
        [True, True, False],
        [True, True, True],
    ]


def test_a_server_follows_the_file(path: Path) -> None:
    tokens = Tokens(TokenFile(path))
    assert not tokens.used
    assert tokens.find("lode_x") is None
    one, kept = TokenFile(path).create("one", ("read",))
    two, _ = TokenFile(path).create("two", ("write", "read"))
    assert tokens.find(one) == kept
    assert tokens.used
    TokenFile(path).revoke("one")
    assert tokens.find(one) is None
    found = tokens.find(two)
    assert found is not None
    assert found.name == "two"
    for text in ("", two[:-1], two + "x", two.upper(), "ö", "\udc80"):
        assert tokens.find(text) is None
    path.unlink()
    # Whoever needed a token goes on needing one.
    assert tokens.find(two) is None
    assert tokens.used


def test_a_token_expires(path: Path) -> None:
    text, token = TokenFile(path).create("short", ("read",), days=1)
    assert token.expires is not None
    assert timedelta(hours=23) < datetime.fromisoformat(token.expires) - datetime.now(UTC) <= timedelta(days=1)
    assert Tokens(TokenFile(path)).find(text) == token
    document = json.loads(path.read_text())
    document["tokens"][0]["expires"] = (datetime.now(UTC) - timedelta(seconds=1)).isoformat()
    path.write_text(json.dumps(document))
    assert Tokens(TokenFile(path)).find(text) is None


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{}",
        '{"version": 2, "tokens": []}',
        '{"version": 1, "tokens": [{"name": "x"}]}',
        '{"version": 1, "tokens": [{"name": "x", "sha256": "00", "scopes": ["read"], "created": ""}]}',
        '{"version": 1, "tokens": [{"name": "x", "sha256": "' + "0" * 64 + '", "scopes": ["root"], "created": ""}]}',
        '{"version": 1, "tokens": [{"name": "x", "sha256": "' + "0" * 64 + '", "scopes": [], "created": ""}]}',
        '{"version": 1, "tokens": [{"name": "x", "sha256": "'
        + "0" * 64
        + '", "scopes": ["read"], "created": "", "expires": "2030-01-01"}]}',
    ],
)
def test_a_file_of_something_else_allows_nobody_anything(path: Path, content: str) -> None:
    text, _ = TokenFile(path).create("one", ("admin",))
    tokens = Tokens(TokenFile(path))
    assert tokens.find(text) is not None
    path.write_text(content)
    assert tokens.find(text) is None
    assert tokens.used
    with pytest.raises(LodestreamError, match="token"):
        Tokens(TokenFile(path))
    with pytest.raises(LodestreamError, match="token"):
        TokenFile(path).create("two", ("admin",))
    assert path.read_text() == content


def test_nothing_of_a_file_that_is_none_is_told(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"secret \xff" * 100_000)
    with pytest.raises(LodestreamError, match="expected a token file") as caught:
        Tokens(TokenFile(path))
    assert len(str(caught.value)) < 500
    assert "secret" not in str(caught.value)


def test_names_are_told_apart_and_missed(path: Path) -> None:
    TokenFile(path).create("one", ("read",))
    with pytest.raises(OptionError, match="'one'"):
        TokenFile(path).create("one", ("write",))
    with pytest.raises(NotFoundError, match="'two'; there are 'one'"):
        TokenFile(path).revoke("two")


def test_the_file_keeps_its_mode(path: Path) -> None:
    TokenFile(path).create("one", ("read",))
    path.chmod(0o640)
    TokenFile(path).create("two", ("read",))
    assert path.stat().st_mode & 0o777 == 0o640


def test_tokens_made_at_once_are_all_there(path: Path) -> None:
    threads = [threading.Thread(target=TokenFile(path).create, args=(f"t{number}", ("read",))) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {token.name for token in TokenFile(path).load()} == {f"t{number}" for number in range(8)}


def test_the_command_makes_lists_and_revokes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ("--data", str(tmp_path))
    assert run("create", "ci", "--scope", "read", "--scope", "write,admin", "--days", "2", *data) == 0
    out, err = capsys.readouterr()
    text = out.removesuffix("\n")
    assert "\n" not in text
    assert str(tmp_path / "tokens.json") in err
    found = Tokens(TokenFile(tmp_path / "tokens.json")).find(text)
    assert found is not None
    assert found.scopes == ("read", "write", "admin")
    assert run("create", *data, "--json") == 0
    made = json.loads(capsys.readouterr().out)
    assert made["scopes"] == ["read"]
    assert made["name"].startswith("token-")
    assert run("list", *data) == 0
    out = capsys.readouterr().out
    assert "ci  read,write,admin" in out
    assert text not in out
    assert run("list", *data, "--json") == 0
    listed = json.loads(capsys.readouterr().out)["tokens"]
    assert [token["name"] for token in listed] == ["ci", made["name"]]
    assert run("revoke", "ci", *data) == 0
    assert run("revoke", made["name"], *data, "--json") == 0
    capsys.readouterr()
    assert run("list", *data) == 0
    assert "no tokens" in capsys.readouterr().err
    with pytest.raises(NotFoundError, match="no tokens at all"):
        run("revoke", "ci", *data)


def test_the_command_takes_the_file_from_the_environment(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LODESTREAM_TOKEN_FILE", str(path))
    assert run("create", "x") == 0
    assert Tokens(TokenFile(path)).find(capsys.readouterr().out.strip()) is not None


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("create", "a b"),
        ("create", "x", "--scope", "root"),
        ("create", "x", "--days", "0"),
        ("create", "x", "--days", "nan"),
        ("create", "x", "--days", "soon"),
        ("revoke",),
    ],
)
def test_a_wrong_command_line_exits_with_2(arguments: tuple[str, ...]) -> None:
    with pytest.raises(SystemExit) as ended:
        run(*arguments)
    assert ended.value.code == 2
