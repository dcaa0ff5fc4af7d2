"""Files named on the command line, including standard input."""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodestream.errors import FormatWarning, InputError, LodestreamError

__all__ = [
    "Inputs",
    "holds_container",
    "input_files",
    "named",
    "option_hints",
    "option_words",
    "reason_of",
]

_STANDARD_INPUT = "standard input"


@dataclass(frozen=True)
class Inputs:
    """Files to read; `filename` is used in messages for input without a name."""

    paths: tuple[Path, ...]
    filename: str | None


@contextmanager
def input_files(names: Sequence[str]) -> Iterator[Inputs]:
    """Yield the files with these names; standard input (``-``), at most once, is copied to a temporary file.

    Readers and uploads need to know the length first, and the end of a container before its middle.

    Raises
    ------
    InputError
        If one is an address.
    """
    from lodestream.opening.open_source import is_address

    for name in filter(is_address, names):
        raise InputError(
            f"{name} is an address, and this command reads files: download it, or receive a container that is on a "
            "server or a web host by lodestream pull"
        )
    if "-" not in names:
        yield Inputs(tuple(map(Path, names)), None)
        return
    with tempfile.NamedTemporaryFile(prefix="lodestream-") as file:
        shutil.copyfileobj(sys.stdin.buffer, file)
        file.flush()
        yield Inputs(tuple(Path(file.name if name == "-" else name) for name in names), _STANDARD_INPUT)


def named(error: LodestreamError, name: str, advice: str = "") -> LodestreamError:
    """Return an error with the file's name before its message and advice after it."""
    words = f"{_STANDARD_INPUT if name == '-' else name}: {error}" + (f"; {advice}" if advice else "")
    error.args = (words, *error.args[1:])
    return error


def reason_of(error: LodestreamError | OSError) -> str:
    """Return the reason of an error in words, for a line about its file."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


@contextmanager
def option_hints(names: Sequence[str]) -> Iterator[None]:
    """Rewrite options of formats in errors and notes as the command line has them: ``-o encoding=grey``.

    Parameters
    ----------
    names : sequence of str
        Of the files; one that an error begins with is left as it is.
    """
    with warnings.catch_warnings():
        show = warnings.showwarning

        def worded(message: Warning | str, category: type[Warning], *more: Any) -> None:
            noted = issubclass(category, FormatWarning)
            show(FormatWarning(option_words(str(message), names)) if noted else message, category, *more)

        warnings.showwarning = worded  # type: ignore[assignment]  # the parameters after these two are handed on
        try:
            yield
        except LodestreamError as error:
            words = option_words(str(error), names)
            error.args = tuple(words if part == str(error) else part for part in error.args)
            raise


def option_words(text: str, names: Sequence[str] = ()) -> str:
    """Return a reader's message with ``-o`` before options of formats, except ``--remesh``; see `option_hints`."""
    from lodestream.formats import formats

    keys = {key for format_ in formats() for key in format_.options}
    called = (f"{word}: " for name in names for word in (name, Path(name).name))  # by servers without folder
    file = next((words for words in called if text.startswith(words)), "")
    hint = re.compile(rf"(?<!-o )(?<=[ (])(?:{'|'.join(sorted(keys))})=")
    return file + hint.sub(r"-o \g<0>", text[len(file) :]).replace("-o remesh=yes", "--remesh")


def holds_container(path: Path) -> bool:
    """Return whether what is there is a container: a file, by its first bytes.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    from lodestream.container.sections import SIGNATURE, is_container

    if path.is_dir():  # as a Zarr store is
        return False
    with path.open("rb") as file:
        return is_container(file.read(len(SIGNATURE)))
