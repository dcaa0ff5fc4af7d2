"""Intermediate files and pictures of ``pull --watch``: the surface as received so far."""

from __future__ import annotations

import stat
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any

from lodestream.errors import FormatWarning, InputError

from ..terminal.output import human_size, note, require_folder
from .outcome import write_surface

if TYPE_CHECKING:
    from lodestream.decoding.view import View
    from lodestream.grid.layout import Layout
    from lodestream.target import Target

    from ..viewer.drawing import Drawing

    _State = tuple[View, Layout, Mapping[str, Any]]

__all__ = ["Watch", "check_picture", "check_watched"]


def check_watched(out: str) -> None:
    """Check early that OUT can be replaced while the surface improves.

    Raises
    ------
    InputError
        If it is a pipe or a device, or its format is a folder, which is not replaced.
    """
    from lodestream.formats import for_writing

    if for_writing(out).folder is not None:
        raise InputError(f"cannot rewrite {out} as the surface improves: it is a folder, and --watch needs a file")
    try:
        mode = Path(out).stat().st_mode
    except OSError:
        return
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):  # a folder is refused by others, in their words
        raise InputError(f"cannot rewrite {out} as the surface improves: it is no file")


def check_picture(picture: Path) -> None:
    """Check early that a picture can be drawn.

    Raises
    ------
    InputError
        If there is no such folder.
    UnavailableError
        If matplotlib is not installed.
    """
    from ..viewer.pictures import require_matplotlib

    require_folder(picture)
    require_matplotlib()


class Watch:
    """Writes the surface received so far into OUT and a picture; a context manager that waits for started work.

    A thread writes, and a process draws, so that nothing waits for them: of the states that come meanwhile the newest
    is next.

    Parameters
    ----------
    out : str
        File to replace.
    drawing : Drawing or None
        Draws states too.
    target : Target
        What of the surface is written.
    metadata : callable
        Returns the metadata of the surface; called with each state, in the caller's thread.
    """

    def __init__(
        self, out: str, drawing: Drawing | None, target: Target, metadata: Callable[[], Mapping[str, Any]]
    ) -> None:
        self._out = out
        self._drawing = drawing
        self._target = target
        self._metadata = metadata
        self._lock = Lock()
        self._next: _State | None = None
        self._thread: Thread | None = None
        self._failed: Exception | None = None
        self._over = False  # the last state is drawn next, which no other is to hold back

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._lock:
            self._over, self._next, thread = True, None, self._thread
        if thread is not None:
            thread.join()
        if kind is None:
            self._check()

    def write(self, view: View, layout: Layout) -> None:
        """Start to write and draw a state, unless a better one follows before.

        Notes of what the format leaves out are given with the last state only.

        Raises
        ------
        FormatError, CorruptStreamError, OSError
            If an earlier one could not be written, or had no value.
        """
        self._check()
        state = view, layout, self._metadata()
        with self._lock:
            self._next = state
            if self._thread is None:
                self._thread = Thread(target=self._work, name="lodestream-watch")
                self._thread.start()

    def _check(self) -> None:
        failed, self._failed = self._failed, None
        if failed is not None:
            raise failed

    def _work(self) -> None:
        while True:
            with self._lock:
                state, self._next = self._next, None
                if state is None:
                    self._thread = None
                    return
            try:
                self._write(*state)
            except Exception as error:  # the caller's thread raises it
                self._failed = error

    def _write(self, view: View, layout: Layout, metadata: Mapping[str, Any]) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FormatWarning)
            write_surface(view.surface(self._target.level, metadata), self._out)
        if self._drawing is not None and not self._over:
            self._drawing.offer(view, layout, metadata)
        within = "at most " if view.bound else ""
        note(f"{self._out}: {human_size(view.bytes)}, level {view.level}, RMS error {within}{view.rms:.4g}")
