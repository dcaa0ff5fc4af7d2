"""The core of a stream: decides what to do next, and does nothing itself.

`Core.effect` is what is to be done now. Whoever has done it says so by `Core.done` or `Core.failed`, and looks again.
All of the policy is here and below: transports, reconnecting, deadlines, pacing, stopping and closing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodestream.errors import InputError, LodestreamError, NotFoundError, RemoteError, TruncatedStreamError

from ..errors import SilenceError, UnreachableError
from ..requests import addresses
from . import over_http, over_websocket
from .effects import Ahead, Dial, Effect, Flow, Get, HangUp, Hear, Read, Send, Wait
from .locating import located
from .session import Session

if TYPE_CHECKING:
    from lodestream.decoding.decoder import View

__all__ = ["Core"]


class Core:
    """A stream as a sequence of effects.

    An effect that was interrupted, for example because a task was cancelled, remains the next one and is carried out
    again.

    Parameters
    ----------
    session : Session
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self._flow = self._travel()
        self._effect: Effect | None = None
        self._begun = False
        self._viewed: float | None = None  # since when somebody looks at a view

    @property
    def met(self) -> bool:
        """Whether the server has answered as expected."""
        return self.session.transports.met

    @property
    def effect(self) -> Effect | None:
        """The next effect to carry out; None if the stream is over. The first access begins the stream.

        Raises
        ------
        LodestreamError
            At the first look, as `done`.
        """
        if not self._begun:
            self._begun = True
            self.done(None)
        session, effect = self.session, self._effect
        if isinstance(effect, Hear):
            # It begins when it is asked for: that somebody looks at a view for long is no silence of the server's.
            until = effect.until if self._viewed is None else effect.until + session.clock() - self._viewed
            until = until if session.close_by is None else min(until, session.close_by)
            self._effect = effect if until == effect.until else Hear(until)
            session.asked = session.clock()
        elif session.stopped and isinstance(effect, Dial | Get | Read):
            # The other side need not be told, so nobody waits for what it says.
            self.failed(TruncatedStreamError(f"expected more of {session.url}, but was stopped"))
        self._viewed = None
        return self._effect

    def next_view(self) -> View | None:
        """Return the next new view; None if there is none now, or something must be sent first.

        Sending first gives the server its credit, or the next request, so that the link is busy while the caller
        handles the view.
        """
        view = None if isinstance(self._effect, Send | Ahead) else self.session.next_view()
        if view is not None:
            self.shown()
        return view

    def shown(self) -> None:
        """Declare that the caller handles a view from now on."""
        if self._viewed is None:
            self._viewed = self.session.clock()

    def done(self, result: object) -> None:
        """Declare that the effect has been carried out.

        Parameters
        ----------
        result : object
            What the class of the effect documents.

        Raises
        ------
        LodestreamError
            If the stream ends with an error; there is no further effect then.
        """
        self._effect = None
        try:
            self._effect = self._flow.send(result)
        except StopIteration:
            return

    def failed(self, error: Exception) -> None:
        """Declare that the effect could not be carried out.

        Parameters
        ----------
        error : Exception
            The error of the library; those that the class of the effect does not document are raised again.

        Raises
        ------
        LodestreamError
            If the stream ends with an error; there is no further effect then.
        """
        self._effect = None
        try:
            self._effect = self._flow.throw(error)
        except StopIteration:
            return

    def _travel(self) -> Flow[None]:
        """Receive over one connection after the other, until the target is met or the deadline is over."""
        session = self.session
        session.transports.start(session.clock())
        while True:
            before, session.withheld = session.reception.cached.total, ""
            try:
                if addresses.is_named(session.url):
                    # Once: the stream ends on the container that it begins, whatever the name leads to by then.
                    session.url = yield from located(session)
                if session.transports.transport == "ws":
                    yield from over_websocket.receive(session)
                else:
                    yield from over_http.receive(session)
                return
            except LodestreamError as error:
                if not session.stopped and isinstance(error, UnreachableError | SilenceError | TruncatedStreamError):
                    session.windows.forget(session.url)
                if isinstance(error, RemoteError | InputError | NotFoundError):
                    error.args = (f"{error}{session.withheld}", *error.args[1:])
                yield HangUp(abort=True)
                if session.over():
                    return
                progressed = session.reception.cached.total > before
                try:
                    pause = session.transports.failed(error, session.clock(), progressed=progressed)
                except LodestreamError:
                    session.truncate()
                    raise
            left = session.reception.tick(session.clock())
            yield Wait(session.clock() + (pause if left is None else min(pause, left)))
            if session.over():
                return
