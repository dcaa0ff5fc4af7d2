"""A process that draws the pictures of ``pull``, so that seconds of drawing do not delay the stream.

This module run as a program is that process. It reads a pickled `Picture` after another from its standard input and
answers each on standard output with a pickled PNG and how much of it is expected to change, or with the error; its
first answer says that it is ready. What it reads first are the layers of the surface, if pictures are to be judged, or
None. It ends when its input does, so also if the program that has started it was killed.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, BinaryIO

from lodestream.errors import LodestreamError, UnavailableError
from lodestream.operating_system import new_session

from .picture_change import DONE, Judge
from .pictures import Picture, write_png

if TYPE_CHECKING:
    from lodestream.decoding.view import View
    from lodestream.grid.layout import Layout
    from lodestream.planning.plan import Mark

    # Bytes of a state, whether it is complete, and what the surface is called.
    _State = tuple[int, bool, str]

__all__ = ["Drawing", "command"]


def command() -> list[str]:
    """Return the command line of the process that draws."""
    return [sys.executable, "-P", "-m", "lodestream_client.viewer.drawing"]


class Drawing:
    """Draws states of a surface into a file, in a process that is started once; a context manager that ends it.

    Parameters
    ----------
    path : Path
        PNG to replace.
    name : str
        What the surface is called if its metadata do not say.
    window : bool
        The states are of a window.
    layers : sequence of Mark, optional
        Judges the pictures: the states of the whole surface in order, see `Judge`.

    Attributes
    ----------
    done : (int, float) or None
        Of the first picture that looks done: bytes of its state, and the share of its pixels that is expected to change
        visibly after it.
    when_done : callable
        Called once, in a thread of its own, when a picture looks done.
    """

    def __init__(self, path: Path, name: str, *, window: bool, layers: Sequence[Mark] | None = None) -> None:
        self.done: tuple[int, float] | None = None
        self.when_done: Callable[[], None] = lambda: None
        self._layers = layers
        self._path = path
        self._name = name
        self._window = window
        self._sent: _State | None = None
        self._next = 0.0  # when a picture that nobody waits for may begin

    def __enter__(self) -> Drawing:
        # A session of its own: Ctrl-C in a terminal is handled here, and ends the process with the block.
        self._process = subprocess.Popen(
            command(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            **new_session(),
        )
        # The thread waits for the process, so that nothing else does.
        self._thread = ThreadPoolExecutor(1, "lodestream-drawing")
        self._answer: Future[None] = self._thread.submit(self._prepared)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._thread.shutdown(cancel_futures=True)
        with self._process:  # closes its pipes and waits for it
            if self._process.stdin is not None:
                _close(self._process.stdin)

    def offer(self, view: View, layout: Layout, metadata: Mapping[str, Any]) -> None:
        """Start to draw a state, unless another one is being drawn or was drawn just now.

        The pause between two pictures is as long as the first one took. So drawing takes at most half of a processor,
        and the last picture waits less often for another one. If a picture could not be drawn, `draw` raises the error.
        """
        if self._answer.done() and self._answer.exception() is None and monotonic() >= self._next:
            self._send(view, layout, metadata)

    def draw(self, view: View, layout: Layout, metadata: Mapping[str, Any]) -> None:
        """Draw a state after the one that is being drawn, unless it is that one, and wait for it.

        Raises
        ------
        LodestreamError, OSError
            If it, or an earlier one, could not be drawn or written.
        """
        self._answer.result()
        if self._sent != self._state(view, metadata):
            self._send(view, layout, metadata)
            self._answer.result()

    def _state(self, view: View, metadata: Mapping[str, Any]) -> _State:
        """Return the values that tell one picture of a stream from another."""
        name = metadata.get("name")
        return view.bytes, view.complete, name if isinstance(name, str) else self._name

    def _send(self, view: View, layout: Layout, metadata: Mapping[str, Any]) -> None:
        self._sent = self._state(view, metadata)
        *_, called = self._sent
        picture = Picture.of(view, None if self._window else layout, called)
        self._answer = self._thread.submit(self._drawn, picture)

    def _prepared(self) -> None:
        self._write(self._layers)
        self._received()

    def _drawn(self, picture: Picture) -> None:
        began = monotonic()
        self._write(picture)
        self._received()
        self._next = 2 * monotonic() - began

    def _write(self, value: object) -> None:
        assert self._process.stdin is not None
        try:
            pickle.dump(value, self._process.stdin, pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()
        except OSError:  # it has ended
            raise self._ended() from None

    def _received(self) -> None:
        """Wait for an answer of the process, and write the picture if it is one."""
        assert self._process.stdout is not None
        try:
            answer = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError):
            raise self._ended() from None
        if isinstance(answer, LodestreamError):
            raise answer
        if answer is not None:
            png, remaining = answer
            write_png(png, self._path)
            if remaining < DONE and self.done is None and self._sent is not None:
                self.done = self._sent[0], remaining
                self.when_done()

    def _ended(self) -> UnavailableError:
        code = self._process.wait()
        return UnavailableError(f"cannot draw {self._path}: the process that draws pictures ended with code {code}")


def _close(pipe: Any) -> None:
    """Close a pipe to an ended process, which takes no more of the buffered data."""
    with suppress(OSError):
        pipe.close()


def serve(pictures: BinaryIO, answers: BinaryIO) -> None:
    """Draw pictures until the input ends; see the head of this module.

    Parameters
    ----------
    pictures, answers : binary files
    """

    def answer(value: tuple[bytes, float] | LodestreamError | None) -> None:
        pickle.dump(value, answers)
        answers.flush()

    import matplotlib.figure  # noqa: F401 - before the first picture, while the stream begins

    answer(None)
    layers: Sequence[Mark] | None = pickle.load(pictures)
    judge = None if layers is None else Judge(layers)
    while True:
        try:
            picture = pickle.load(pictures)
        except EOFError:
            return
        try:
            png = picture.png()
            remaining = float("nan") if judge is None else judge.remaining(picture.stage, picture.pixels())
        except LodestreamError as error:
            answer(error)
        except Exception as error:  # of a library that does not say what it may raise
            words = " ".join(str(error).split())
            answer(UnavailableError(f"the picture cannot be drawn: {type(error).__name__}: {words}"))
        else:
            answer((png, remaining))


if __name__ == "__main__":
    # What a library may print is no answer.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    serve(sys.stdin.buffer, answers)
