"""The model of the settings, and everything that is made from it."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from lodestream.container import capacity
from lodestream.errors import OptionError
from lodestream_server import Settings
from lodestream_server.access.tokens import tokens_of
from lodestream_server.commands.serve import chosen_settings, register
from lodestream_server.operation.bounds import Bounds
from lodestream_server.operation.settings import GROUPS, Choice, choices
from tests.server import manual


def parse(*arguments: str) -> Settings:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    return chosen_settings(parser.parse_args(["serve", *arguments]))


CHOICES = choices()


def example(choice: Choice) -> str:
    """Text for a value that is not the default."""
    if choice.words:
        return choice.words[-1]
    if choice.is_switch:
        return "yes"
    known = {
        "formats": "text,npy",
        "dask": "tcp://10.0.0.2:8786",
        "origins": "https://a.example",
        "trusted_proxies": "::1",
    }
    if choice.name in known:
        return known[choice.name]
    if choice.metavar == "SIZE":
        return "3GiB"
    return "7" if choice.field.annotation in (int, int | None, float) else "/x"


@pytest.fixture(autouse=True)
def _bare(monkeypatch: pytest.MonkeyPatch) -> None:
    for choice in CHOICES.values():
        monkeypatch.delenv(choice.variable, raising=False)


def test_the_page_is_made_from_the_model() -> None:
    assert manual.PATH.read_text() == manual.render(), "run python -m tests.server.manual"
    assert {choice.group for choice in CHOICES.values()} == set(GROUPS)
    assert set(CHOICES) | set(Bounds.model_fields) == set(Settings.model_fields)


@pytest.mark.parametrize(
    ("name", "replacement"), [("upload_rate", "least_rate"), ("max_client_streams", "max_streams")]
)
def test_a_setting_that_is_gone_says_what_replaced_it(
    monkeypatch: pytest.MonkeyPatch, name: str, replacement: str
) -> None:
    words = f"the setting {name} is gone: use {replacement}"
    assert name not in Settings.model_fields
    assert replacement in Settings.model_fields
    page = (manual.PATH.parent / "operating.md").read_text()
    assert f"`{name}`" in page
    with pytest.raises(ValidationError, match=words):
        Settings.model_validate({name: 1000})
    monkeypatch.setenv(f"LODESTREAM_{name.upper()}", "1000")
    with pytest.raises(OptionError, match=f"^{words}"):
        parse()


@pytest.mark.parametrize("setting", CHOICES.values(), ids=CHOICES)
def test_each_is_a_variable_and_an_option_and_the_option_wins(setting: Choice, monkeypatch: pytest.MonkeyPatch) -> None:
    default, text = getattr(parse(), setting.name), example(setting)
    arguments = [setting.option] if setting.is_switch else [setting.option, text]
    given = getattr(parse(*arguments), setting.name)
    assert given != default
    monkeypatch.setenv(setting.variable, text)
    assert getattr(parse(), setting.name) == getattr(Settings(), setting.name) == given
    if setting.is_switch:
        assert getattr(parse(f"--no-{setting.option[2:]}"), setting.name) is False
    monkeypatch.setenv(setting.variable, "")
    assert getattr(parse(), setting.name) == default


def test_help_tells_every_option_with_its_default() -> None:
    parser = argparse.ArgumentParser()
    subparsers = parser.add_subparsers()
    register(subparsers)
    # Lines are broken after hyphens, too.
    text = "".join(subparsers.choices["serve"].format_help().split())
    for setting in CHOICES.values():
        assert f"{setting.meaning} (default: {setting.default_text})".replace(" ", "") in text, setting.name
        assert setting.option in text


@pytest.mark.parametrize(
    ("text", "size"),
    [("1000", 1000), ("4GiB", 4 << 30), ("1.5 MiB", 3 << 19), ("2kB", 2000), ("3g", 3 * 10**9), ("0", 0)],
)
def test_sizes_carry_units(text: str, size: int) -> None:
    assert CHOICES["keep_free"].take(text) == Settings(keep_free=text).keep_free == size  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("keep_free", "4 pounds", "expected bytes"),
        ("keep_free", "-1", "expected bytes"),
        ("upload_bytes", 0, "greater than or equal to 1"),
        ("port", 65536, "less than or equal to 65535"),
        ("memory", "1MiB", "greater than or equal to 268435456"),
        ("idle_seconds", "nan", "finite number"),
        ("idle_seconds", 0, "greater than 0"),
        ("max_streams", 0, "greater than or equal to 1"),
        ("insecure", "perhaps", "a valid boolean"),
        ("log_format", "xml", "'text' or 'json'"),
        ("formats", "npy,exe", "some of npy"),
        ("origins", "foo", "https://maps.example.org"),
        ("origins", "https://a.example/path", "https://maps.example.org"),
        ("trusted_proxies", "300.1.1.1", "10.0.0.0/8"),
        ("formats", "", "got none"),
        ("root_path", "maps/", "begins with a slash"),
        ("data", "a\0b", "a path"),
    ],
)
def test_what_cannot_be_is_said(name: str, value: Any, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Settings(**{name: value})


@pytest.mark.parametrize(
    ("option", "text", "words"),
    [
        ("--port", "many", "expected a whole number, got 'many'"),
        ("--port", "70000", "expected 0 to 65535, got"),
        ("--memory", "1MB", "expected at least 256MiB, got"),
        ("--upload-bytes", "4 pounds", "expected bytes, such as 1000000 or 4GiB, got '4 pounds'"),
        ("--workers", "0", "expected at least 1, got"),
        ("--data", "", "expected a path, got ''"),
    ],
)
def test_the_command_line_says_what_is_expected(
    option: str, text: str, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        parse(option, text)
    assert words in capsys.readouterr().err
    if text:
        monkeypatch.setenv(CHOICES[option[2:].replace("-", "_")].variable, text)
        with pytest.raises(OptionError, match=f": {re.escape(words)}"):
            parse()


def test_lists_and_paths() -> None:
    settings = parse("--origins", " https://a.example , https://b.example,", "--data", "here")
    assert settings.origins == ("https://a.example", "https://b.example")
    assert settings.data == Path("here")
    assert tokens_of(settings).place == "here/tokens.json"
    assert tokens_of(parse("--token-file", "there")).place == "there"
    assert parse("--data", "S3://bucket/a/b/").data == "s3://bucket/a/b"


def test_bounds_are_no_business_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LODESTREAM_MAX_STREAMS", "3")
    assert Settings().max_streams == Bounds().max_streams
    assert Settings(max_streams=3).max_streams == 3


def test_memory_is_divided_among_builds_and_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    for there in (16 << 30, 1 << 40):
        monkeypatch.setattr(capacity, "memory_limit", lambda there=there: there)
        for workers in (1, 2, 3, 7):
            chosen = Settings(workers=workers)
            assert chosen.memory_of_build * workers <= there // 2
            assert chosen.memory_of_build * workers + chosen.memory_of_levels + chosen.memory_of_streams < there
    assert Settings(memory=8 << 30, workers=4).memory_of_build == 2 << 30
    assert Settings(memory=8 << 30, workers=4).memory_of_levels == 4 << 30
    assert Settings(memory=8 << 30, workers=4).memory_of_streams == 2 << 30
    assert Settings(stream_memory=0).memory_of_streams == 0
    assert Settings(workers=1000000).memory_of_build == 512 << 20
    assert Settings(build_memory=1 << 30).memory_of_build == 1 << 30
