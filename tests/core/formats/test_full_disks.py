"""Files that do not fit onto the disk: an error that says so, nothing left, and the process goes on."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE

pytest.importorskip("h5netcdf")
resource = pytest.importorskip("resource")

_WRITE = """
import resource, signal, sys
import numpy, lodestream
sys.dont_write_bytecode = True  # modules that are imported under the limit would be kept cut short, for everybody
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
random = numpy.random.default_rng(1)
values = {"q": random.normal(size=(300, 300))}
surface = lodestream.Surface(random.normal(size=(300, 300)), attributes=values)
lodestream.write(surface, sys.argv[1] + ".first.nc")
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
try:
    lodestream.write(surface, sys.argv[1])
except OSError as error:
    print(error.errno, error.filename)
"""


@pytest.mark.sweep(3)
@pytest.mark.parametrize("limit", [1, 900_000, 20_000, 2_000, 700_000, 1_300_000])
@pytest.mark.long
def test_a_netcdf_that_does_not_fit_is_told_and_kills_nobody(tmp_path: Path, limit: int) -> None:
    # HDF5 ends a process whose writes fail.
    path = tmp_path / "a.nc"
    done = subprocess.run(
        [sys.executable, "-c", _WRITE, path, str(limit)], capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == f"{errno.EFBIG} {path}"
    assert [it.name for it in tmp_path.iterdir()] == ["a.nc.first.nc"]
    assert (tmp_path / "a.nc.first.nc").stat().st_size > limit


_STORE = """
import resource, sys
import numpy, lodestream
sys.dont_write_bytecode = True
surface = lodestream.Surface(numpy.random.default_rng(1).normal(size=(700, 1500)))
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
for _ in range(5):
    try:
        lodestream.write(surface, sys.argv[1])
    except OSError as error:
        print(error.errno, error.filename)
"""


@pytest.mark.sweep(2)
@pytest.mark.parametrize("limit", [3_000, 300_000, 1, 20_000])
@pytest.mark.long
def test_a_store_that_does_not_fit_leaves_nothing(tmp_path: Path, limit: int) -> None:
    # Threads of zarr were still writing chunks while the folder was removed.
    pytest.importorskip("zarr")
    path = tmp_path / "a.zarr"
    done = subprocess.run(
        [sys.executable, "-c", _STORE, path, str(limit)], capture_output=True, text=True, timeout=PATIENCE
    )
    assert (done.returncode, done.stdout.strip()) == (0, "\n".join([f"{errno.EFBIG} {path}"] * 5)), done.stderr
    assert list(tmp_path.iterdir()) == []
