"""The exceptions and warnings of Lodestream.

::

    LodestreamError
    ├── InputError (ValueError)          the caller's input cannot be used
    │   ├── FormatError                  a file is invalid, cut short, or not a structured surface
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

__all__ = [
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
]


class LodestreamError(Exception):
    """Base class of all exceptions of Lodestream."""


class InputError(LodestreamError, ValueError):
    """The caller's input cannot be used."""


class FormatError(InputError):
    """A file is invalid, cut short, or not a structured surface."""


class SwitchedOffError(FormatError):
    """A file has a format that is switched off here; its contents were not looked at."""


class FormatWarning(UserWarning):
    """Something was left out of a file or of a surface, or had to be assumed; the message says what."""


class TooLargeError(InputError):
    """More bytes or vertices than allowed."""


class OptionError(InputError):
    """An option, level or format that does not exist, or a value that it does not take."""


class UnavailableError(LodestreamError):
    """Something that is needed is missing, whatever the input: a library is not installed, or a process was killed."""


class NotFoundError(LodestreamError, LookupError):
    """There is no such surface."""


class StreamError(LodestreamError):
    """The bytes of a container cannot be used."""


class CorruptStreamError(StreamError):
    """The bytes of a container are damaged.

    Attributes
    ----------
    offset : int
        Offset in the container, in bytes, of the part that failed its check.
    """

    def __init__(self, message: str, offset: int) -> None:
        super().__init__(f"{message} (at byte {offset})")
        self.offset = offset


class TruncatedStreamError(StreamError):
    """A container ends too early."""


class UnsupportedVersionError(StreamError):
    """A container or a peer has a version that this program does not support."""


class ProtocolError(LodestreamError):
    """A message that the protocol does not allow."""


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
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
