"""What a server or a file says does nothing to a terminal, and is told exactly in JSON."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
import lodestream_client
from lodestream_client.terminal import output
from tests.patience import PATIENCE

from ..conftest import Run
from ..scripted import document, problem, scripted

# A colour, the clipboard, a title, one of the eight-bit kind, an order of letters; then rich's markup and an emoji.
EVIL = "m\x1b[31m\x1b]52;c;ZWNobw==\x07\x1b]0;title\x1b\\\x9b2J\u202e\u2066[red]x[/red][link=http://a]:smile:\ud800"
SEEN = r"m\x1b[31m\x1b]52;c;ZWNobw==\x07\x1b]0;title\x1b\\x9b2J\u202e\u2066[red]x[/red][link=http://a]:smile:\ud800"


def harmless(*texts: str) -> bool:
    return all(char == "\n" or char.isprintable() for text in texts for char in text)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container whose metadata and attributes are named so."""
    points = np.add.outer(np.arange(20.0), np.arange(30.0))
    name = EVIL[:-1]  # MessagePack has no lone surrogate
    surface = ls.Surface(points, attributes={name: points})
    surface.metadata.update({"units": name, name: "key", "recognised": name, "name": name})
    path = tmp_path_factory.mktemp("hostile") / "hostile.lode"
    path.write_bytes(ls.encode(surface))
    return path


def test_info_of_a_container(hostile: Path, run: Run) -> None:
    code, stdout, stderr = run("info", hostile)
    assert code == 0
    assert harmless(stdout, stderr)
    assert stdout.count(SEEN[: SEEN.index(":smile")][:60]) >= 3
    told = json.loads(run("info", hostile, "--json")[1])
    assert told["metadata"]["units"] == EVIL[:-1], "exact"
    assert told["attributes"] == [EVIL[:-1]]


def test_units_of_a_netcdf(tmp_path: Path, run: Run) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    path, out = tmp_path / "a.nc", tmp_path / "a.lode"
    heights = xarray.DataArray(np.add.outer(np.arange(20.0), np.arange(30.0)), dims=("y", "x"), name="z")
    heights.attrs.update(units=EVIL[:-1], long_name=EVIL[:-1])
    heights.to_netcdf(path, engine="h5netcdf")
    code, stdout, stderr = run("encode", path, out)
    assert code == 0, stderr
    assert harmless(stdout, stderr)
    code, stdout, stderr = run("info", out)
    assert r"m\x1b[31m" in stdout
    assert harmless(stdout, stderr)


@pytest.mark.parametrize("as_json", [False, True])
def test_what_a_server_says(as_json: bool, run: Run) -> None:
    surface = {
        "id": EVIL,
        "url": "/v1/surfaces/ab",
        "state": "ready",
        "name": EVIL,
        "dtype": EVIL,
        "attributes": [EVIL],
        "values_sha256": EVIL,
        "bytes": 7,
        "metadata": {EVIL: [EVIL], "notes": [EVIL]},
    }
    more = ["--json"] if as_json else []
    with scripted(lambda asked: document({**surface, "surfaces": [surface]})) as server:
        url = f"{server.url}/v1/surfaces/ab"
        for command in (("info", url), ("list", server.url), ("retry", url)):
            code, stdout, stderr = run(*command, *more)
            assert code == 0, stderr
            assert harmless(stdout, stderr)
            assert "u202e" in stdout + stderr
            if as_json:
                told = json.loads(stdout)
                assert told.get("surfaces", [told])[0]["name"] == EVIL


def test_what_a_server_says_is_wrong(run: Run, tmp_path: Path) -> None:
    for answer in (problem(404, "not-found", EVIL), problem(500, EVIL, EVIL), document({"state": EVIL, "id": EVIL})):
        with scripted(lambda _: answer) as server:  # noqa: B023
            url = f"{server.url}/v1/surfaces/ab"
            for command in (("info", url), ("list", server.url), ("pull", url, tmp_path / "o.npy", "--retry", "0")):
                code, stdout, stderr = run(*command)
                assert (code, stdout) == (1, "")
                assert harmless(stderr)
                assert len(stderr.splitlines()) == 1


@pytest.mark.parametrize("command", [("info",), ("decode", "-"), ("nonsense",), ("encode", "x.npy", "x.lode")])
def test_names_that_somebody_else_gave(command: tuple[str, ...], run: Run, tmp_path: Path) -> None:
    code, stdout, stderr = run(*command, f"not there {EVIL[:-1]}\udcff")
    assert code != 0
    assert harmless(stdout, stderr)
    assert r"\x1b[31m" in stderr or command[0] == "nonsense"


def test_a_file_of_such_a_name(hostile: Path, tmp_path: Path, run: Run) -> None:
    path = tmp_path / "[red]\x1b[31m.lode"
    path.write_bytes(hostile.read_bytes())
    code, stdout, stderr = run("info", path)
    assert (code, stderr) == (0, "")
    assert r"[red]\x1b[31m.lode" in stdout
    assert harmless(stdout)


def test_warnings_and_logs_of_libraries() -> None:
    code = (
        "import logging, warnings\n"
        "from lodestream.errors import FormatWarning\n"
        "from lodestream_client.terminal.output import clean_warnings\n"
        "with clean_warnings():\n"
        f"    warnings.warn({EVIL!a}, UserWarning)\n"
        f"    warnings.warn({EVIL!a}, FormatWarning)\n"
        f"    logging.getLogger('x').error({EVIL!a})\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert done.stderr.count(r"\x1b]52;c;ZWNobw==\x07") == 3
    assert harmless(done.stderr)


def test_a_progress_bar_takes_no_markup() -> None:
    columns = output._drawn().columns
    assert columns
    assert all(not getattr(column, "markup", False) for column in columns)


@pytest.mark.parametrize("command", ["encode", "decode"])
def test_work_whose_steps_are_minutes_apart_has_its_time_left(
    command: str, container_file: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    periods, now = list[float](), [0.0]

    @contextmanager
    def unseen(period: float = 30.0) -> Iterator[output.Progress]:
        periods.append(period)
        yield output._Unseen()

    monkeypatch.setattr(f"lodestream_client.commands.{command}.progress_bar", unseen)
    given = (container_file, tmp_path / "a.npy") if command == "decode" else (tmp_path / "b.npy", tmp_path / "b.lode")
    np.save(tmp_path / "b.npy", np.add.outer(np.arange(20.0), np.arange(30.0)))
    assert run(command, *given)[0] == 0
    (period,) = periods
    bar = output._drawn(period)
    bar.get_time = lambda: now[0]
    task = bar.add_task("encoding", total=1.0, figures="")
    for step in (0.01, 0.02, 0.03):
        now[0] += 200
        bar.update(task, completed=step)
    left = bar.columns[-1]
    assert not isinstance(left, str)
    assert str(left.render(bar.tasks[0])) == "5:23 h left"


@pytest.mark.parametrize("terminal", [False, True])
def test_a_bar_is_drawn_on_a_terminal_alone(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    monkeypatch.setenv("TERM", "xterm")
    with output.progress_bar() as bar:
        task = bar.add_task("sending", total=1.0, figures="3 kB")
        bar.update(task, completed=0.5)
        bar.remove_task(task)
    said = capsys.readouterr()
    assert said.out == ""
    assert bool(said.err) == terminal


def test_everything_that_is_said_goes_one_way() -> None:
    """No other module of the client prints, or writes to a standard stream, but the bytes of a surface."""
    folder = Path(lodestream_client.__file__).parent
    found = []
    for path in folder.rglob("*.py"):
        if path.name == "output.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                if called in ("print", "Console") or called.endswith(("stdout.write", "stderr.write")):
                    found.append(f"{path.relative_to(folder)}:{node.lineno}: {called}")
    assert found == []
