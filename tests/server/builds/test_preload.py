"""What is loaded before processes are forked leaves no file open: they close all files, and reuse their numbers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not list open files")

PROGRAM = """
import os
before = set(os.listdir("/proc/self/fd"))
from lodestream_server.builds.worker import preload
preload()
for number in sorted(set(os.listdir("/proc/self/fd")) - before, key=int):
    name = f"/proc/self/fd/{number}"
    if os.path.isfile(name):
        print(os.readlink(name))
"""


@pytest.mark.long
def test_no_file_is_open() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout == ""
