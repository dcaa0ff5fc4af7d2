"""Kernels where nothing can be kept on disk: they are compiled all the same, and that is said once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

#: numba as it is where neither its folder, nor the package's, nor the user's can be written. Permissions do not bind
#: root, so the package's own folder is taken out of the list.
NOWHERE = """
from numba.core import caching
caching.CacheImpl._locator_classes = [
    kind for kind in caching.CacheImpl._locator_classes if kind is not caching.InTreeCacheLocator
]
"""

EVERY_MODULE = """
import importlib, pkgutil
import lodestream
for module in pkgutil.walk_packages(lodestream.__path__, "lodestream."):
    importlib.import_module(module.name)
"""

KERNELS = """
from lodestream import numba_kernels as kernels
for make in (kernels.kernel, kernels.bare_kernel, kernels.strict_kernel):
    @make
    def total(most):
        found = 0
        for number in range(most):
            found += number
        return found
    assert total(10) == 45
    assert total.signatures, "it was compiled"
print(kernels.unkept())
"""


def run(script: Path, folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run a program that may keep its kernels in a folder alone."""
    script.write_text(NOWHERE + code)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "NUMBA_CACHE_DIR": str(folder / "kernels"),
        "HOME": str(folder / "home"),
        "XDG_CACHE_HOME": str(folder / "cache"),
    }
    done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True, timeout=200)
    assert not done.returncode, done.stderr
    return done


def test_where_nothing_can_be_kept_kernels_are_compiled_and_it_is_said_once(tmp_path: Path) -> None:
    file = tmp_path / "file"  # below it nobody makes a folder
    file.write_text("")
    done = run(tmp_path / "script.py", file, EVERY_MODULE + KERNELS)
    assert "NUMBA_CACHE_DIR" in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == done.stderr


def test_where_they_can_be_kept_nothing_is_said(tmp_path: Path) -> None:
    done = run(tmp_path / "script.py", tmp_path, KERNELS)
    assert (done.stdout, done.stderr) == ("None\n", "")
    assert [path.name for path in (tmp_path / "kernels").rglob("script.total-*.nbi")]
