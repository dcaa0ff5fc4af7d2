"""The exceptions and warnings of Lodestream.

::

    LodestreamError
    ├── InputError (ValueError)          the caller's input cannot be used
    │   ├── FormatError                  a file is invalid, cut short, or not a structured surface
    │   │   ├── ChoiceError              a file has several surfaces, and options have to choose one
    │   │   └── SwitchedOffError         a file's format is switched off
    │   ├── TooLargeError                more bytes or vertices than allowed
    │   └── OptionError                  an option, level or format that does not exist; the message names valid ones
    ├── UnavailableError                 a library is not installed, or a helper process was killed
    ├── NotFoundError (LookupError)      no such surface
    ├── StreamError                      the bytes of a container cannot be used
    │   ├── CorruptStreamError           damaged, with the offset
    │   ├── TruncatedStreamError         ends too early
    │   └── UnsupportedVersionError      another format version; the message names both
    ├── ProtocolError                    a message that the protocol does not allow
    │   ├── LocalProtocolError           sent by this side
    │   └── RemoteProtocolError          sent by the other side
    └── RemoteError                      the other side refused a request, with its code and reason

    FormatWarning (UserWarning)          a file or format does not hold everything

There is one class for each way in which a caller may want to react. Each message says what was expected, what was
found, and where.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

__all__ = [
    "Choice",
    "ChoiceError",
    "CorruptStreamError",
    "FormatError",
    "FormatWarning",
    "InputError",
    "LocalProtocolError",
    "LodestreamError",
    "NotFoundError",
    "OptionError",
    "ProtocolError",
    "RemoteError",
    "RemoteProtocolError",
    "StreamError",
    "SwitchedOffError",
    "TooLargeError",
    "TruncatedStreamError",
    "UnavailableError",
    "UnsupportedVersionError",
    "named",
]


class LodestreamError(Exception):
    """Base class of all exceptions of Lodestream.

    Examples
    --------
    >>> import lodestream
    >>> try:
    ...     lodestream.decode(b"something else")
    ... except lodestream.LodestreamError as error:
    ...     print(type(error).__name__)
    CorruptStreamError
    """


class InputError(LodestreamError, ValueError):
    """The caller's input cannot be used.

    Examples
    --------
    >>> import lodestream
    >>> lodestream.encode([1.0, 2.0, 3.0])
    Traceback (most recent call last):
    lodestream.errors.InputError: expected an array of shape (H, W), (H, W, 2), (H, W, 3) ..., got shape (3,)
    """


class FormatError(InputError):
    """A file is invalid, cut short, or not a structured surface.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> number = pathlib.Path("notes.tif").write_text("no raster")
    >>> lodestream.read("notes.tif")
    Traceback (most recent call last):
    lodestream.errors.FormatError: notes.tif: this is text that begins with 'no raster', though ...
    """


@dataclass(frozen=True)
class Choice:
    """Options by which one of the surfaces of a file is read.

    Attributes
    ----------
    options : mapping of str to str
        Beside those that were given.
    shape : tuple of int
        Rows and columns; empty if they are not known.
    """

    options: Mapping[str, str]
    shape: tuple[int, ...] = ()


class ChoiceError(FormatError):
    """A file has several surfaces, and options have to choose one.

    Attributes
    ----------
    choices : tuple of Choice
        Options that choose. There may be more, of which the message tells.

    Examples
    --------
    >>> import lodestream, numpy
    >>> numpy.savez("two.npz", low=numpy.zeros((4, 5)), high=numpy.ones((4, 5)))
    >>> try:
    ...     lodestream.read("two.npz")
    ... except lodestream.ChoiceError as error:
    ...     print([choice.options for choice in error.choices])
    [{'array': 'low'}, {'array': 'high'}]
    """

    def __init__(self, message: str, choices: Iterable[Choice] = ()) -> None:
        super().__init__(message)
        self.choices = tuple(choices)


class SwitchedOffError(FormatError):
    """A file has a format that is switched off here; its contents were not read.

    Examples
    --------
    >>> import lodestream
    >>> lodestream.read("terrain.npy", allowed=["geotiff"])
    Traceback (most recent call last):
    lodestream.errors.SwitchedOffError: terrain.npy: ...
    """


class FormatWarning(UserWarning):
    """Something was left out of a file or of a surface, or had to be assumed; the message says what.

    Examples
    --------
    >>> import lodestream, warnings
    >>> surface = lodestream.Surface([[1.0, 2.0], [3.0, 4.0]], metadata={"unit": "m"})
    >>> with warnings.catch_warnings(record=True) as notes:
    ...     warnings.simplefilter("always")
    ...     lodestream.write(surface, "small.npy")
    >>> print(notes[0].message)
    NPY is written without unit, which it cannot hold
    """


class TooLargeError(InputError):
    """More bytes or vertices than allowed.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> lodestream.decode(pathlib.Path("terrain.lode").read_bytes(), max_vertices=100)
    Traceback (most recent call last):
    lodestream.errors.TooLargeError: expected at most 100 vertices (max_vertices), got 6,790
    """


class OptionError(InputError):
    """An option, level or format that does not exist, or a value that it does not take.

    Examples
    --------
    >>> import lodestream
    >>> lodestream.Target(order="size")
    Traceback (most recent call last):
    lodestream.errors.OptionError: expected order quality or level, got 'size'
    """


class UnavailableError(LodestreamError):
    """Something that is needed is missing, whatever the input: a library is not installed, or a process was killed.

    Examples
    --------
    >>> import lodestream
    >>> surface = lodestream.read("terrain.npy")
    >>> try:
    ...     mesh = surface.to_trimesh()
    ... except lodestream.UnavailableError as error:
    ...     print(error)  # names the extra to install
    """


class NotFoundError(LodestreamError, LookupError):
    """There is no such surface.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream_client import Client
    >>> try:
    ...     Client("http://127.0.0.1:8000").get("00000000000000000000")
    ... except lodestream.NotFoundError:
    ...     print("no such surface")
    no such surface
    """


class StreamError(LodestreamError):
    """The bytes of a container cannot be used.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> decoder = lodestream.Decoder()
    >>> try:
    ...     views = decoder.feed(pathlib.Path("terrain.lode").read_bytes()[:3000] + bytes(1000))
    ... except lodestream.StreamError:
    ...     surface = decoder.surface()  # what came before the damage
    >>> surface.shape
    (97, 70)
    """


class CorruptStreamError(StreamError):
    """The bytes of a container are damaged.

    Attributes
    ----------
    offset : int
        Offset in the container, in bytes, of the part that failed its check.

    Examples
    --------
    >>> import lodestream
    >>> try:
    ...     lodestream.decode(b"something else")
    ... except lodestream.CorruptStreamError as error:
    ...     print(error.offset)
    0
    """

    def __init__(self, message: str, offset: int) -> None:
        super().__init__(f"{message} (at byte {offset})")
        self.offset = offset


class TruncatedStreamError(StreamError):
    """A container ends too early.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> try:
    ...     lodestream.decode(pathlib.Path("terrain.lode").read_bytes()[:3000])
    ... except lodestream.TruncatedStreamError:
    ...     print("cut short")
    cut short
    """


class UnsupportedVersionError(StreamError):
    """A container or a peer has a version that this program does not support.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> container = pathlib.Path("terrain.lode").read_bytes()
    >>> lodestream.decode(container[:7] + bytes([9]) + container[8:])
    Traceback (most recent call last):
    lodestream.errors.UnsupportedVersionError: expected a container of version 1, the one this program reads, got ...
    """


class ProtocolError(LodestreamError):
    """A message that the protocol does not allow.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream_client import Client
    >>> try:
    ...     found = Client("http://127.0.0.1:8000").list()
    ... except lodestream.ProtocolError:
    ...     print("not a server of Lodestream")
    """


class LocalProtocolError(ProtocolError):
    """This side tried to send a message that the protocol does not allow now."""


class RemoteProtocolError(ProtocolError):
    """The other side sent a message that the protocol does not allow now."""


class RemoteError(LodestreamError):
    """The other side refused the request.

    Attributes
    ----------
    code : str
        Code from the table of error codes in ``docs/protocol.md``.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream_client import Client
    >>> try:
    ...     description = Client("http://127.0.0.1:8000").upload("terrain.npy")
    ... except lodestream.RemoteError as error:
    ...     print(error.code)  # waiting, busy, disk-full, ...
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@contextmanager
def named(place: object) -> Iterator[None]:
    """Add to an error of this package, as a note, which file or address it is about."""
    try:
        yield
    except LodestreamError as error:
        error.add_note(f"in {place}")
        raise
