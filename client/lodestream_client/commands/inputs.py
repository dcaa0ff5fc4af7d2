"""Files named on the command line, standard input among them."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lodestream.errors import LodestreamError

__all__ = ["Inputs", "input_files", "named"]

_STANDARD_INPUT = "standard input"


@dataclass(frozen=True)
class Inputs:
    """Files to read; `filename` is used in messages for input without a name."""

    paths: tuple[Path, ...]
    filename: str | None


@contextmanager
def input_files(names: Sequence[str]) -> Iterator[Inputs]:
    """The files with these names; standard input (``-``), at most once, is copied to a temporary file.

    Readers and uploads need to know the length first, and the end of a container before its middle.
    """
    if "-" not in names:
        yield Inputs(tuple(map(Path, names)), None)
        return
    with tempfile.NamedTemporaryFile(prefix="lodestream-") as file:
        shutil.copyfileobj(sys.stdin.buffer, file)
        file.flush()
        yield Inputs(tuple(Path(file.name if name == "-" else name) for name in names), _STANDARD_INPUT)


def named(error: LodestreamError, name: str, advice: str = "") -> LodestreamError:
    """The same error, with the file's name before its message and advice after it."""
    words = f"{_STANDARD_INPUT if name == '-' else name}: {error}" + (f"; {advice}" if advice else "")
    error.args = (words, *error.args[1:])
    return error
