"""Leaving a stream early is no error of anybody's: nothing is printed or logged, whatever is on its way."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from lodestream import Target, Tolerance
from lodestream_client import Client

from ..conftest import Run, make_terrain


@pytest.fixture(scope="module")
def large(server: str) -> str:
    """A surface of which much is on its way while its first layers are looked at."""
    return Client(server).upload(make_terrain(700, 500)).url


def test_many_streams_that_are_left_log_nothing(large: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        for number in range(60):
            with Client(large).connect(large) as stream:
                for _, _ in zip(range(number % 6 + 1), stream, strict=False):
                    pass
    assert caplog.messages == []


@pytest.mark.long
def test_none_of_300_streams_to_their_end_logs_anything(large: str, caplog: pytest.LogCaptureFixture) -> None:
    target = Target(until_rms=Tolerance(1e-2, relative=True))
    ended = set()
    with caplog.at_level(logging.WARNING):
        for _ in range(300):
            with Client(large).connect(large, target=target, transport="ws") as stream:
                for _ in stream:
                    pass
            ended.add(stream.ended)
    assert caplog.messages == []
    assert ended == {"rms"}


@pytest.mark.parametrize("options", [("--roi", "10:60,10:60"), ("--max-bytes", "20000"), ("--until-max", "20")])
def test_a_pull_that_stops_early_prints_its_figures_only(
    run: Run, large: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, options: tuple[str, ...]
) -> None:
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            code, _, stderr = run("pull", large, tmp_path / "out.npy", *options)
            assert code == 0, stderr
            assert all(line.startswith("lodestream: ") for line in stderr.splitlines())
            assert "Error" not in stderr
    assert caplog.messages == []
    assert np.isfinite(np.load(tmp_path / "out.npy")).all()
