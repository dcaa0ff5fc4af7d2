"""Lets pytest run with another library of kernels: ``pytest -p tests.kernels.plugin --kernels LIBRARY``.

Where the library counts which of its lines run, the counts are written when the tests end.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from lodestream import library


def pytest_addoption(parser: pytest.Parser) -> None:
    """Take the library's path."""
    parser.addoption("--kernels", type=Path, required=True, help="a library of kernels, in place of the installed one")


def pytest_configure(config: pytest.Config) -> None:
    """Let it be loaded; in the processes of pytest-xdist too."""
    path: Path = config.getoption("kernels").resolve()
    if path.name != library.library_name():
        raise pytest.UsageError(f"expected a file {library.library_name()}, got {path}")
    library.NATIVE = path.parent
    missing = library.why_missing()
    if missing is not None:
        raise pytest.UsageError(missing)


def pytest_unconfigure() -> None:
    """Write which lines have run: processes of pytest-xdist end without doing it."""
    write = getattr(library.library(), "lode_write_coverage", None)
    if write is not None:
        write()
