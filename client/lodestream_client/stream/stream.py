"""Properties that both kinds of stream share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..requests.api import Identity, identity_of_file
from .core import Core
from .options import ConnectOptions
from .session import Session

if TYPE_CHECKING:
    from lodestream.decoding.decoder import Decoder
    from lodestream.protocol.messages import Opened

__all__ = ["BaseStream"]


class BaseStream:
    """A surface being received.

    Parameters
    ----------
    url : str
        URL of the surface or file.
    options : ConnectOptions

    Attributes
    ----------
    target : Target
        What to receive, where to stop, and in which order.

    Raises
    ------
    OptionError, ValueError
        As `Session`.
    """

    def __init__(self, url: str, options: ConnectOptions) -> None:
        self._session = Session(url, options)
        self._core = Core(self._session)
        self._reception = self._session.reception
        self.target = self._reception.target

    @property
    def url(self) -> str:
        """The URL of the surface or file."""
        return self._session.url

    @property
    def silence(self) -> float:
        """Seconds without data after which a connection counts as lost; may be set at any time.

        Raises
        ------
        ValueError
            If it is set to a number that is not positive.
        """
        return self._session.silence

    @silence.setter
    def silence(self, seconds: float) -> None:
        self._session.silence = seconds

    @property
    def decoder(self) -> Decoder:
        """The decoder of the data that have arrived; after `stop` it may hold more than the last view."""
        return self._reception.decoder

    @property
    def header(self) -> Opened | None:
        """The server's first message over the WebSocket: SHA-256 and size of the container, and the planned bytes."""
        download = self._session.download
        return download.answer if download is not None else None

    @property
    def identity(self) -> Identity:
        """Identity of the container, as far as the server has told it."""
        container, size = self._reception.container, self._reception.size
        if container is not None:
            return Identity(container, container, size)
        ranges = self._session.ranges
        return identity_of_file(self.url, ranges.version if ranges is not None else None, size)

    @property
    def planned(self) -> int | None:
        """Bytes of the surface that the target needs; None until they are known."""
        return self._reception.planned

    @property
    def received(self) -> int:
        """Bytes of the surface that are here, received or from the store."""
        return self._reception.received

    @property
    def wire_bytes(self) -> int:
        """Bytes of all messages and answers received."""
        return self._reception.wire_bytes

    @property
    def data_bytes(self) -> int:
        """Bytes of the container received."""
        return self._reception.data_bytes

    @property
    def transport(self) -> str:
        """The transport in use: ``ws`` or ``http``."""
        return self._session.transports.transport

    @property
    def connections(self) -> int:
        """Number of connections so far; over HTTP, number of requests."""
        return self._session.connections

    @property
    def metadata_place(self) -> tuple[int, int] | None:
        """Offset and length of the container's metadata, once they are known."""
        return self._reception.metadata_place

    @property
    def ended(self) -> str | None:
        """Reason why the stream ended; None while it has not.

        complete, level, rms, max, bytes or seconds, as the target says; stopped by this side; truncated by an error.
        """
        return self._session.ended

    def _repr_html_(self) -> str:
        """Return the HTML for a notebook: the bytes received, and the last view."""
        from lodestream.interop.html import table

        planned = "" if self.planned is None else f" of {self.planned:,}"
        rows = [
            ("source", self.url),
            ("received", f"{self.received:,}{planned} bytes"),
            ("transport", f"{self.transport}, {self.connections} connections or requests"),
            ("state", self.ended or "receiving"),
        ]
        layers = self.decoder.layers
        return table("Stream", rows, None) + (layers[-1]._repr_html_() if layers else "")
