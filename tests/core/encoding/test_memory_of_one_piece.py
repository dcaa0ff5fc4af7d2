"""Surfaces in one piece are encoded in the memory that is promised."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.encoding.memory import whole_memory
from lodestream.parallel import VARIABLE

from ..surfaces import terrain

#: What does not grow with the surface: room that threads keep, windows that are measured one after another.
FIXED = 2 << 20

#: Encodes heights in a file; prints how much more memory of its own the process has at most meanwhile.
SCRIPT = """
import re, sys, threading
from pathlib import Path
import numpy as np
import lodestream as ls

def anonymous():
    return int(re.search(r"RssAnon:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024

heights, rms = np.load(sys.argv[1]), float(sys.argv[2]) or None
ls.encode(heights[:99, :99].copy(), rms=rms)  # what is loaded once
before = peak = anonymous()
done = threading.Event()

def watch():
    global peak
    while not done.wait(0.001):
        peak = max(peak, anonymous())

watcher = threading.Thread(target=watch)
watcher.start()
ls.encode(heights, rms=rms)
done.set()
watcher.join()
print(peak - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell what memory is anonymous")
@pytest.mark.parametrize(("dtype", "rms"), [("float64", 0.0), ("float32", 0.01)])
@pytest.mark.long
def test_what_is_promised_holds_in_one_piece(tmp_path: Path, dtype: str, rms: float) -> None:
    heights = (terrain((1200, 1000)) + np.random.default_rng(3).normal(size=(1200, 1000)) / 100).astype(dtype)
    np.save(tmp_path / "heights.npy", heights)
    # Arrays that are gone are given back at once.
    environment = {**os.environ, VARIABLE: "1", "MALLOC_MMAP_THRESHOLD_": "131072"}
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "heights.npy"), str(rms)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    promised = whole_memory(ls.Surface(heights), bool(rms))
    assert int(done.stdout) < promised + FIXED
    assert promised < (48 if rms else 22) * heights.size + 1
