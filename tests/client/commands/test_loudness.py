"""``-q`` and ``-v``, and what is said of tokens."""

from __future__ import annotations

import logging
import re
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lodestream_client.terminal import output
from lodestream_server import running_server
from tests.client import files
from tests.client.conftest import Run
from tests.patience import PATIENCE

HEIGHTS = np.add.outer(np.arange(40.0) ** 2, np.arange(50.0)).astype("f4")


@pytest.fixture
def array(tmp_path: Path) -> Path:
    np.save(tmp_path / "a.npy", HEIGHTS)
    return tmp_path / "a.npy"


def test_quiet_commands_print_errors_and_results_only(array: Path, run: Run) -> None:
    container = array.with_suffix(".lode")
    code, out, said = run("encode", array, container)
    assert (code, out) == (0, "")
    assert "points" in said
    assert run("encode", "-q", array, container) == (0, "", "")
    code, out, said = run("info", "--quiet", container)
    assert (code, said) == (0, "")
    assert "40 x 50" in out
    code, out, said = run("decode", "-q", array.with_name("none.lode"), array.with_name("b.npy"))
    assert (code, out) == (1, "")
    assert "none.lode" in said
    _, _, said = run("encode", array, container)
    assert "points" in said, "the next command is as loud as ever"


def test_verbose_commands_print_requests_reads_and_times(array: Path, run: Run) -> None:
    pytest.importorskip("matplotlib")
    container = array.with_suffix(".lode")
    assert run("encode", "-q", array, container)[0] == 0
    with files.ranged(array.parent) as host:
        code, out, said = run("view", "-v", f"{host.url}/a.lode", "--png", array.with_name("a.png"))
    assert (code, out) == (0, "")
    assert re.search(rf"^lodestream: HTTP Request: GET {host.url}/a\.lode .*206", said, re.MULTILINE)
    assert re.search(rf"^lodestream: read \d+ bytes at \d+ of {host.url}/a\.lode in \d\.\d+ s$", said, re.MULTILINE)
    assert not logging.getLogger("lodestream").handlers


def test_it_is_one_or_the_other(array: Path) -> None:
    from lodestream_client.program import main

    with pytest.raises(SystemExit):
        main(["info", "-q", "-v", str(array)])


def test_who_needs_a_token_is_told_how_to_give_it(
    array: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LODESTREAM_TOKEN", raising=False)
    out = array.with_name("b.npy")
    assert run("token", "create", "ci", "--scope", "write", "--data", tmp_path / "data")[0] == 0
    with running_server(tmp_path / "data", workers=1) as url:
        for more in ((), ("--token", "mistyped")):
            for command in (("push", array, url), ("pull", f"{url}/v1/surfaces/{'0' * 32}", out), ("list", url)):
                code, printed, said = run(*command, *more)
                assert (code, printed) == (1, "")
                assert said.rstrip().endswith("; the token is given by --token or LODESTREAM_TOKEN"), said


@pytest.mark.parametrize("long", [False, True])
def test_what_takes_long_has_a_bar(
    long: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with output.working("reading\x1b", delay=0.0 if long else 1000.0):
        until = time.monotonic() + PATIENCE
        while long and output._Speech.bars and time.monotonic() < until:
            time.sleep(0.01)
        with output.progress_bar() as inner:
            task = inner.add_task("another", total=1.0, figures="")
            inner.update(task, completed=1.0)
    said = capsys.readouterr().err
    assert ("reading\\x1b" in said) == long
    assert ("another" in said) != long, "one bar at a time"


def test_quiet_commands_have_no_bars(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    for quiet in (True, False):
        with output.speaking(verbose=not quiet, quiet=quiet), output.progress_bar() as bar:
            bar.update(bar.add_task("sending", total=1.0, figures=""), completed=1.0)
    assert capsys.readouterr().err == ""
