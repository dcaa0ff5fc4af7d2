"""``lodestream publish``: what it takes, what it says, and wrong command lines."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream_client.program import main
from lodestream_client.publishing.page_address import cors_rule, page_address

HILLS = np.add.outer(np.sin(np.arange(60) / 9), np.cos(np.arange(80) / 7)).astype(np.float32)


@pytest.fixture
def container(tmp_path: Path) -> Path:
    path = tmp_path / "hills.lode"
    path.write_bytes(ls.encode(ls.Surface(HILLS, metadata={"name": "The hills"})))
    return path


def entries(store: Path) -> list[dict[str, object]]:
    found: list[dict[str, object]] = json.loads((store / "view.json").read_text())["surfaces"]
    return found


@pytest.mark.usefixtures("built")
def test_a_container_is_published_as_it_is(tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    assert main(["publish", str(container), str(store)]) == 0
    told = capsys.readouterr()
    assert told.out == f"{store / 'index.html'}\n"
    assert f"{store / 'index.html'}#hills" in told.err
    (entry,) = entries(store)
    assert (entry["name"], entry["title"], entry["bytes"]) == ("hills", "The hills", container.stat().st_size)
    assert (store / str(entry["src"])).read_bytes() == container.read_bytes()


@pytest.mark.usefixtures("built")
def test_other_files_are_encoded_first_to_the_same_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "hills.npy", HILLS)
    store = tmp_path / "store"
    given = ["publish", str(tmp_path / "hills.npy"), str(store), "--precision", "0.01", "--name", "my hills", "--json"]
    for sent in (True, False):
        assert main(given) == 0
        report = json.loads(capsys.readouterr().out)
        assert bool(report["sent"]) == sent
        assert report["surfaces"][0]["page"].endswith("#my%20hills")
    (entry,) = entries(store)
    decoded = ls.decode((store / str(entry["src"])).read_bytes())
    assert np.abs(decoded.points - HILLS).max() <= 0.01
    assert (entry["name"], entry.get("title")) == ("my hills", None)


@pytest.mark.usefixtures("built")
def test_names_are_removed(tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / "store"
    assert main(["publish", str(container), str(store)]) == 0
    assert main(["unpublish", "dales", str(store)]) == 1
    assert "'dales'" in capsys.readouterr().err
    assert main(["unpublish", "hills", str(store), "--keep", "0"]) == 0
    assert entries(store) == []
    assert not list(store.rglob("*.lode"))
    assert main(["published", str(store)]) == 0
    assert "no surfaces" in capsys.readouterr().err


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("kind", ["damaged", "options", "no raster", "missing"])
def test_what_cannot_be_published_is_told_before_anything_is_sent(
    tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    given, store = [str(container)], tmp_path / "store"
    if kind == "damaged":
        container.write_bytes(container.read_bytes()[:-9])
    elif kind == "options":
        given += ["--precision", "1"]
    elif kind == "no raster":
        container.write_bytes(ls.encode(np.random.default_rng(1).normal(size=(9, 9, 3))))
        given += ["--levels"]
    else:
        given += [str(tmp_path / "dales.npy")]
    assert main(["publish", *given, str(store)]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert {"damaged": "hills.lode", "options": "hills.lode", "no raster": "even", "missing": "dales.npy"}[
        kind
    ] in told.err
    assert not store.exists()


@pytest.mark.usefixtures("built")
def test_a_container_comes_on_standard_input(tmp_path: Path, container: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(container.read_bytes())))
    assert main(["publish", "-", str(tmp_path / "store"), "--name", "piped"]) == 0
    (entry,) = entries(tmp_path / "store")
    assert (tmp_path / "store" / str(entry["src"])).read_bytes() == container.read_bytes()


@pytest.mark.usefixtures("built")
def test_notes_of_levels_are_one_and_refusals_name_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = [0.0, 30.0, 0.0, 4_200_000.0, 0.0, -30.0]
    (tmp_path / "hills.lode").write_bytes(ls.encode(ls.Surface(HILLS, metadata={"geotransform": place})))
    assert main(["publish", str(tmp_path / "hills.lode"), str(tmp_path / "store"), "--levels"]) == 0
    told = capsys.readouterr().err
    assert told.count("off by up to a cell") == 1
    assert "evenly spaced" not in told
    (tmp_path / "curve.lode").write_bytes(ls.encode(np.random.default_rng(1).normal(size=(9, 9, 3))))
    assert main(["publish", str(tmp_path / "curve.lode"), str(tmp_path / "store"), "--levels"]) == 1
    assert f"{tmp_path / 'curve.lode'}: --levels: expected heights" in capsys.readouterr().err
    assert main(["published", str(tmp_path / "store" / "index.html")]) == 0


@pytest.mark.usefixtures("built")
def test_a_store_that_is_in_use_is_told_before_anything_is_encoded(
    tmp_path: Path, container: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "lodestream.json").write_text("{}")
    monkeypatch.setattr("lodestream_client.commands.publish._container", lambda *_: pytest.fail("too late"))
    assert main(["publish", str(container), str(tmp_path / "store")]) == 1
    assert "holds lodestream.json, which lodestream publish has not put there" in capsys.readouterr().err


def test_a_page_that_is_not_built_is_told(
    tmp_path: Path, container: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lodestream.page.assets", dict)
    assert main(["publish", str(container), str(tmp_path / "store")]) == 1
    assert "make page" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["hills.lode"],
        ["hills.lode", "http://127.0.0.1:1/"],
        ["a/hills.lode", "b/hills.npy", "store"],
        ["hills.lode", "dales.lode", "store", "--name", "one"],
        ["-", "store"],
        ["hills.lode", "store", "--keep", "-1"],
        ["hills.lode", "store", "--keep", "nan"],
        ["hills.lode", "store", "--name", "two\nlines"],
        ["hills.lode", "store", "--name", ""],
        ["hills.lode", __file__],
        ["hills.lode", "store", "--public-url", "ftp://host/"],
        ["hills.lode", "store", "--public-url", "https://me:SECRET@host/"],
        ["hills.lode", "https://me:SECRET@host/"],
    ],
)
def test_wrong_command_lines(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["publish", *arguments])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert "error" in told
    assert "SECRET" not in told


@pytest.mark.parametrize(
    ("address", "environment", "expected"),
    [
        ("s3://maps/a~b", {}, "https://maps.s3.us-east-1.amazonaws.com/a~b/index.html"),
        ("s3://my.maps/a", {}, "https://s3.us-east-1.amazonaws.com/my.maps/a/index.html"),
        ("s3://maps", {"AWS_REGION": "eu-west-1"}, "https://maps.s3.eu-west-1.amazonaws.com/index.html"),
        ("s3://maps/a/", {"AWS_ENDPOINT_URL": "http://127.0.0.1:9/"}, "http://127.0.0.1:9/maps/a/index.html"),
        ("az://maps/a", {"AZURE_STORAGE_ACCOUNT_NAME": "me"}, "https://me.blob.core.windows.net/maps/a/index.html"),
        ("az://maps/a", {"AZURE_STORAGE_ENDPOINT": "http://127.0.0.1:9/me"}, "http://127.0.0.1:9/me/maps/a/index.html"),
        ("abfss://maps@mine.dfs.core.windows.net/a", {}, "https://mine.blob.core.windows.net/maps/a/index.html"),
    ],
)
def test_the_address_of_the_page(
    monkeypatch: pytest.MonkeyPatch, address: str, environment: dict[str, str], expected: str
) -> None:
    for name in [name for name in os.environ if name.startswith(("AWS_", "AZURE_"))]:
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert page_address(address, None) == expected
    assert page_address(address, "https://cdn.example/x/") == "https://cdn.example/x/index.html"


def test_the_rule_that_lets_other_pages_read() -> None:
    command = cors_rule("s3://maps/a")
    assert command is not None
    rule = json.loads(command.partition("'")[2].rstrip("'"))["CORSRules"][0]
    assert rule["AllowedMethods"] == ["GET", "HEAD"]
    assert {"range", "if-range"} <= set(rule["AllowedHeaders"])
    assert {"content-range", "etag"} <= set(rule["ExposeHeaders"])
    assert cors_rule("az://maps/a") is not None
    assert cors_rule("/srv/maps") is None
