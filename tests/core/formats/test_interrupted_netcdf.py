"""A NetCDF whose writing is interrupted: the interruption is told, nothing is left, and the process goes on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE

pytest.importorskip("h5netcdf")

#: Interrupts the main thread as a key does, while HDF5 is in one of its calls of the file.
_WRITE = """
import signal, sys
import numpy, lodestream
from lodestream.formats.netcdf.hdf5_output import Output

calls, write = 0, Output.write
def interrupted(self, data):
    global calls
    calls += 1
    if calls == int(sys.argv[2]):
        signal.raise_signal(signal.SIGINT)
        for _ in range(100_000):
            pass
    return write(self, data)
Output.write = interrupted
try:
    lodestream.write(lodestream.Surface(numpy.random.default_rng(1).normal(size=(1000, 300))), sys.argv[1])
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.usefixtures("interrupts")
@pytest.mark.skipif(sys.platform == "win32", reason="signals are others")
@pytest.mark.parametrize("call", [1, 2, 5, 12])
@pytest.mark.long
def test_an_interruption_is_told_and_kills_nobody(tmp_path: Path, call: int) -> None:
    command = [sys.executable, "-c", _WRITE, str(tmp_path / "a.nc"), str(call)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")
    assert list(tmp_path.iterdir()) == []
