"""Output of the commands: results to standard output, everything else to standard error, files by renaming.

No other module of the client writes to a terminal. Messages contain text from files and servers, so all text passes
`printable` here: lines in `note`, `say` and `say_columns`, table cells in `cell`, which also keeps brackets from being
taken for markup. JSON is ASCII with JSON's own escapes, and exact.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import secrets
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from lodestream.errors import FormatWarning, InputError
from lodestream.text import printable

if TYPE_CHECKING:
    import rich.progress
    from rich.console import Console
    from rich.text import Text

__all__ = [
    "LONG",
    "GroupingParser",
    "Parser",
    "Progress",
    "cell",
    "clean_warnings",
    "complain",
    "console",
    "human_size",
    "human_time",
    "note",
    "note_details",
    "note_holes",
    "point_words",
    "print_json",
    "progress_bar",
    "replacing",
    "require_folder",
    "require_parent",
    "say",
    "say_columns",
    "say_script",
    "speaking",
    "working",
]

#: What ``-v`` prints, and from which level on: that of httpx has a line for each request.
_LOGGED = {"lodestream": logging.DEBUG, "lodestream_client": logging.DEBUG, "httpx": logging.INFO}


#: For `progress_bar`, of work that may take hours: its steps are minutes apart.
LONG = 900.0


class _Speech:
    """How much is printed beside results and errors; one for the program, as standard error is."""

    quiet = False
    bars = True


def note(text: str) -> None:
    """Print one line that is not part of the result, but for ``-q``."""
    if not _Speech.quiet:
        complain(text)


def complain(text: str) -> None:
    """Print one line about an error."""
    print(f"lodestream: {printable(' '.join(text.split()))}", file=sys.stderr)


@contextmanager
def speaking(*, verbose: bool, quiet: bool) -> Iterator[None]:
    """Print less or more within the block.

    Parameters
    ----------
    verbose : bool
        Also what is logged: requests, what is read, how long it takes. It takes the place of bars.
    quiet : bool
        Errors and results alone.
    """
    before = _Speech.quiet, _Speech.bars
    _Speech.quiet, _Speech.bars = quiet, not (verbose or quiet)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Printable("lodestream: %(message)s"))
    loggers = [(logging.getLogger(name), level) for name, level in _LOGGED.items()] if verbose else []
    levels = [logger.level for logger, _ in loggers]
    try:
        for logger, level in loggers:
            logger.addHandler(handler)
            logger.setLevel(level)
        yield
    finally:
        for (logger, _), level in zip(loggers, levels, strict=True):
            logger.removeHandler(handler)
            logger.setLevel(level)
        _Speech.quiet, _Speech.bars = before


def say(text: str) -> None:
    """Print one line of the result."""
    print(printable(text))


def say_columns(rows: Sequence[Sequence[str]]) -> None:
    """Print each row on one line, however long, in columns; columns that are empty in all rows are left out.

    Parameters
    ----------
    rows : sequence of sequence of str
        All of one length.
    """
    from rich.cells import cell_len

    lines = [[printable(text) for text in row] for row in rows]
    widths = [max(map(cell_len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        padded = (text + " " * (width - cell_len(text)) for text, width in zip(line, widths, strict=True) if width)
        print("  ".join(padded).rstrip())


def say_script(text: str) -> None:
    """Print the lines of a script as they are; none of them may come from files or servers."""
    print(text)


def cell(*lines: object) -> Text:
    """Return the contents of a table cell, printed literally."""
    from rich.text import Text

    return Text("\n".join(printable(str(line)) for line in lines))


class Parser(argparse.ArgumentParser):
    """An argument parser whose error messages are safe to print."""

    def error(self, message: str) -> NoReturn:
        """Print usage and message, and end the program with 2."""
        super().error(printable(message))


class GroupingParser(Parser):
    """A parser whose help has its sub-commands in groups.

    Parameters
    ----------
    groups : mapping of str to sequence of str
        Names of sub-commands by heading; those that none of them has are in the last group.
    **options
        Of `argparse.ArgumentParser`.
    """

    def __init__(self, groups: Mapping[str, Sequence[str]], **options: Any) -> None:
        super().__init__(**options)
        self._groups = groups

    def format_help(self) -> str:
        """Return the help: usage, description, a list of commands for each heading, options, epilog."""
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        (commands,) = (action for action in self._actions if isinstance(action, argparse._SubParsersAction))
        summaries = {choice.dest: choice for choice in commands._choices_actions}
        groups = [[summaries.pop(name) for name in names if name in summaries] for names in self._groups.values()]
        groups[-1] += summaries.values()
        for heading, group in zip(self._groups, groups, strict=True):
            formatter.start_section(heading)
            formatter.add_arguments(group)
            formatter.end_section()
        formatter.start_section("options")
        formatter.add_arguments(action for action in self._actions if action is not commands)
        formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()


@contextmanager
def clean_warnings() -> Iterator[None]:
    """Print warnings and log lines of libraries as `note` does."""
    handler = logging.lastResort  # what is used where nobody has set anything up, as here
    formatter = handler.formatter if handler is not None else None
    with warnings.catch_warnings():
        warnings.simplefilter("always", FormatWarning)
        warnings.showwarning = partial(_show_warning, warnings.showwarning)
        if handler is not None:
            handler.setFormatter(_Printable())
        try:
            yield
        finally:
            if handler is not None:
                handler.setFormatter(formatter)


class _Printable(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return "\n".join(map(printable, super().format(record).splitlines()))


def _show_warning(
    others: Callable[..., None], message: Warning | str, category: type[Warning], *place: Any, **more: Any
) -> None:
    """Print a warning about data that a file leaves out as a note, not as a line of the program."""
    if issubclass(category, FormatWarning):
        note(str(message))
    else:
        others(printable(str(message)), category, *place, **more)


def point_words(details: Mapping[str, Any]) -> str:
    """Return the number of points and holes of a surface as text, from the keys of ``info``."""
    total, holes, kept = _points(details), details.get("holes") or 0, details.get("non_finite") or 0
    words = f", {kept} of these infinite or partly NaN, whose values are kept" if kept else ""
    return f"{total}, {holes} of them holes{words}" if holes else str(total)


def _points(details: Mapping[str, Any]) -> int:
    return sum(math.prod(block["shape"]) for block in details["blocks"])


def note_holes(holes: int, total: int, show: Callable[[str], None] = note) -> None:
    """Note how many points are holes, if any are."""
    if holes:
        show(f"{holes} of {total} points {'is a hole' if holes == 1 else 'are holes'}")


def note_details(
    details: Mapping[str, Any], words: Callable[[str], str] = str, show: Callable[[str], None] = note
) -> None:
    """Print the notes of a server's build, of lost or chosen data and holes, or show them otherwise.

    ``words`` puts a note as the command line has it.
    """
    notes = (details.get("metadata") or {}).get("notes")
    for text in notes if isinstance(notes, list) else ():  # in a container somebody may have put anything there
        show(words(str(text)))
    if details.get("blocks"):
        note_holes(details.get("holes") or 0, _points(details), show)


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object, alone on a line of standard output, in printable ASCII."""
    print(json.dumps(value, allow_nan=False, ensure_ascii=True))


def human_size(size: float) -> str:
    """Return a number of bytes as text with a unit."""
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


def human_time(seconds: float) -> str:
    """Return the remaining time as text."""
    whole = math.ceil(seconds)
    if whole < 60:
        return f"{whole} s left"
    minutes, whole = divmod(whole, 60)
    return f"{minutes}:{whole:02} left" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02} h left"


def console(*, stderr: bool = False) -> Console:
    """Return a console for tables; wide if the output is not a terminal, so that lines do not wrap."""
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    return Console(file=stream, width=None if stream.isatty() else 200, soft_wrap=not stream.isatty(), highlight=False)


class Progress(Protocol):
    """A bar for each running task, with rich's interface."""

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> Any:
        """Add a task, and return its identifier for `update` and `remove_task`."""

    def update(self, task_id: Any, **changes: Any) -> None:
        """Change the given values: ``completed``, ``total``, ``description``, fields."""

    def remove_task(self, task_id: Any) -> None:
        """Remove a task."""


class _Unseen:
    """Bars where there is no terminal."""

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> Any:
        return None

    def update(self, task_id: Any, **changes: Any) -> None:
        pass

    def remove_task(self, task_id: Any) -> None:
        pass


@contextmanager
def progress_bar(period: float = 30.0) -> Iterator[Progress]:
    """Show a progress bar on standard error, if that is a terminal.

    If a task has a field ``limit``, it is the maximum number of seconds that it may take.

    Parameters
    ----------
    period : float
        Seconds of the past from which the time left is estimated; what is told less than twice in them has none.
    """
    if not (_Speech.bars and sys.stderr.isatty()):
        yield _Unseen()
        return
    _Speech.bars = False  # one at a time: what has a bar of its own within this one shows none
    try:
        with _drawn(period) as bar:
            yield bar
    finally:
        _Speech.bars = True


@contextmanager
def working(words: str, delay: float = 1.0) -> Iterator[None]:
    """Show a bar without an end on standard error, if that is a terminal, as soon as the block takes long.

    Parameters
    ----------
    words : str
        What is done.
    delay : float
        Seconds until there is a bar.
    """
    if not (_Speech.bars and sys.stderr.isatty()):
        yield
        return
    with ExitStack() as shown:

        def show() -> None:
            shown.enter_context(progress_bar()).add_task(printable(words), total=None, figures="")

        timer = threading.Timer(delay, show)
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            timer.join()


def _drawn(period: float = 30.0) -> rich.progress.Progress:
    from rich import progress
    from rich.text import Text

    class TimeLeft(progress.ProgressColumn):
        max_refresh = 0.5

        def render(self, task: progress.Task) -> Text:
            left = [] if task.time_remaining is None else [task.time_remaining]
            if task.fields.get("limit") is not None and task.elapsed is not None:
                left.append(max(task.fields["limit"] - task.elapsed, 0.0))
            return Text(human_time(min(left)) if left else "", style="progress.remaining")

    return progress.Progress(
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.TextColumn("{task.fields[figures]}", markup=False),
        TimeLeft(),
        console=console(stderr=True),
        speed_estimate_period=period,
        transient=True,
    )


def require_parent(path: Path) -> None:
    """Check early that there is a folder to make a file or a folder in.

    Raises
    ------
    InputError
        Naming the folder.
    """
    if not path.parent.is_dir():
        raise InputError(f"cannot write {path}: there is no folder {path.parent}")


def require_folder(path: Path) -> None:
    """Check early that the folder of a file exists.

    Raises
    ------
    InputError
        Naming the folder.
    """
    require_parent(path)
    if path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary file beside `path`, with the same suffix, that replaces it if the block succeeds."""
    require_folder(path)
    temporary = path.with_name(f".{path.stem[:50]}-{secrets.token_hex(6)}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
