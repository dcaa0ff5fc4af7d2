"""What ``encode(out=)`` may be called: names as long as a file system takes, and pipes behind links."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls

HEIGHTS = np.add.outer(np.arange(400.0) ** 2, np.arange(400.0)).astype(np.float32)  # by bands, if MiB are few


@pytest.mark.parametrize("letter", ["a", "é", "山", "😀"])
@pytest.mark.parametrize("said", [{}, {"memory": "1MiB"}])
def test_a_name_of_255_bytes_is_written(tmp_path: Path, letter: str, said: dict[str, Any]) -> None:
    name = letter * (250 // len(letter.encode()))
    try:
        (tmp_path / f"{name}.lode").write_bytes(b"")
    except OSError:
        pytest.skip("the file system takes shorter names only")
    ls.encode(HEIGHTS, out=tmp_path / f"{name}.lode", **said)
    assert (tmp_path / f"{name}.lode").read_bytes() == ls.encode(HEIGHTS)
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.lode"]
    ls.write(ls.Surface(HEIGHTS), tmp_path / f"{name}.npy")
    np.testing.assert_array_equal(np.load(tmp_path / f"{name}.npy"), HEIGHTS)


@pytest.mark.skipif(not Path("/dev/stdout").exists(), reason="the system has no name for standard output")
def test_a_pipe_behind_a_link_is_written_to() -> None:
    script = "import numpy, lodestream; lodestream.encode(numpy.ones((9, 9)), out='/dev/stdout')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout == ls.encode(np.ones((9, 9)))
