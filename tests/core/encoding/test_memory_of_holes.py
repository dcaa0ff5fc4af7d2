"""Surfaces with holes are encoded in the memory that is promised."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.encoding.memory import BESIDE, least_memory

SHAPE = (4096, 1024)

#: Encodes heights and holes that lie in files; prints how much memory of its own the process has at most.
SCRIPT = """
import re, sys, threading
from pathlib import Path
import numpy as np
import lodestream as ls

def anonymous():
    return int(re.search(r"RssAnon:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024

heights, mask = (np.load(f"{sys.argv[1]}/{name}.npy", mmap_mode="r") for name in ("heights", "mask"))
done, peak = threading.Event(), 0

def watch():
    global peak
    while not done.wait(0.001):
        peak = max(peak, anonymous())

watcher = threading.Thread(target=watch)
watcher.start()
ls.encode(ls.Surface(heights, mask=mask), out=f"{sys.argv[1]}/a.lode", memory="1MiB")
done.set()
watcher.join()
print(peak)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell what memory is anonymous")
@pytest.mark.long
def test_what_is_promised_holds_for_holes(tmp_path: Path) -> None:
    rows, columns = np.indices(SHAPE, np.int32)
    heights = (rows // 7 + columns // 5 + rows * columns % 5).astype(np.int16)
    mask = (rows // 64 + columns // 32) % 7 != 0
    np.save(tmp_path / "heights.npy", heights)
    np.save(tmp_path / "mask.npy", mask)
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path)], capture_output=True, text=True, check=True)
    promised = least_memory(ls.Surface(heights, mask=mask))
    assert promised < BESIDE + 8 * heights.size
    assert int(done.stdout) < promised
    found = ls.decode((tmp_path / "a.lode").read_bytes())
    assert found.mask is not None
    np.testing.assert_array_equal(found.mask, mask)
    np.testing.assert_array_equal(found.points[mask], heights[mask])
