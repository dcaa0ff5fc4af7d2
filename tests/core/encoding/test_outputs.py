"""Where a container goes: links, pipes and long names."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from tests.patience import PATIENCE


@pytest.mark.parametrize("memory", [None, "1MiB"])
def test_a_link_stays_a_link_and_a_pipe_a_pipe(tmp_path: Path, memory: str | None) -> None:
    heights = np.add.outer(np.arange(600) ** 2, np.arange(300)).astype(np.int32)
    expected = ls.encode(heights)
    (tmp_path / "link.lode").symlink_to("real.lode")
    ls.encode(heights, out=tmp_path / "link.lode", memory=memory)
    assert (tmp_path / "link.lode").is_symlink()
    assert (tmp_path / "real.lode").read_bytes() == expected
    os.mkfifo(tmp_path / "pipe.lode")
    with ThreadPoolExecutor(1) as reader:
        read = reader.submit((tmp_path / "pipe.lode").read_bytes)
        ls.encode(heights, out=tmp_path / "pipe.lode", memory=memory)
        assert read.result(PATIENCE) == expected
    assert (tmp_path / "pipe.lode").is_fifo()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.lode", "pipe.lode", "real.lode"]


def test_a_name_may_be_long(tmp_path: Path) -> None:
    path = tmp_path / f"{'a' * 240}.lode"
    heights = np.add.outer(np.arange(600) ** 2, np.arange(300)).astype(np.int32)
    ls.encode(heights, out=path, memory="1MiB")
    assert path.read_bytes() == ls.encode(heights)
