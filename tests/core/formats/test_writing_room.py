"""NetCDF and Zarr of surfaces in files: written by strips of rows, not from copies in memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROWS = COLUMNS = 8192

#: Writes heights and holes that lie in files; prints how much memory of its own the process took for that at most.
SCRIPT = """
import re, sys, threading
from pathlib import Path
import numpy as np
import lodestream as ls
from lodestream.scratch import FolderScratch

def anonymous():
    return int(re.search(r"RssAnon:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024

folder, dtype, suffix, rows, columns = *sys.argv[1:4], *map(int, sys.argv[4:])
ls.write(ls.Surface(np.ones((2, 2), dtype)), f"{folder}/small.{suffix}")  # loads what writing needs
scratch = FolderScratch(f"{folder}/arrays")
heights = scratch.empty("heights", (rows, columns), dtype)
heights[:100] = 7
mask = scratch.empty("mask", (rows, columns), bool)
mask[:-50] = True
place = {"geotransform": [500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0], "nodata": -9999}
surface = ls.Surface(heights, mask=mask, metadata=place)
done, peak, before = threading.Event(), 0, anonymous()

def watch():
    global peak
    while not done.wait(0.001):
        peak = max(peak, anonymous())

watcher = threading.Thread(target=watch)
watcher.start()
ls.write(surface, f"{folder}/large.{suffix}")
done.set()
watcher.join()
print(peak - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell what memory is anonymous")
@pytest.mark.parametrize(("suffix", "dtype"), [("nc", "float32"), ("zarr", "int16")])
@pytest.mark.long
def test_memory_does_not_hold_the_surface(tmp_path: Path, suffix: str, dtype: str) -> None:
    pytest.importorskip("h5netcdf" if suffix == "nc" else "zarr")
    command = [sys.executable, "-c", SCRIPT, tmp_path, dtype, suffix, ROWS, COLUMNS]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=True)
    copy = ROWS * COLUMNS * (2 if dtype == "int16" else 4)
    # Bands of four million values, of which a search for holes has a few; x and y as planes were a gigabyte.
    assert int(done.stdout) < max(copy * 2 // 3, 100 << 20), f"of {copy} bytes"
