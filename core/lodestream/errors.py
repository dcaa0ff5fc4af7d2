"""Everything that Lodestream raises on purpose.

::

    LodestreamError
    ├── InputError (ValueError)          what you gave cannot be used
    │   ├── FormatError                  a file is not what it says, is cut short, or holds no structured surface
    │   │   └── SwitchedOffError         its format may not be read here
    │   ├── TooLargeError                more bytes or vertices than allowed
    │   └── OptionError                  an option, level or format that does not exist; names those that do
    ├── UnavailableError                 what is needed is not here now: a library, a process that was ended
    ├── NotFoundError (LookupError)      no such surface
    ├── StreamError                      the bytes of a container cannot be used
    │   ├── CorruptStreamError           damaged, with the offset
    │   ├── TruncatedStreamError         ends before what was asked for
    │   └── UnsupportedVersionError      of another version than this program reads, naming both
    ├── ProtocolError                    a message out of turn or out of shape
    │   ├── LocalProtocolError           by this side
    │   └── RemoteProtocolError          by the other side
    └── RemoteError                      the other side refused, with its code and reason

    FormatWarning (UserWarning)          a file cannot say all of a surface

One class for each reaction that a caller may have. Each message says what was expected, what came, and where.
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
    """Base of everything that Lodestream raises on purpose."""


class InputError(LodestreamError, ValueError):
    """What the caller gave cannot be used."""


class FormatError(InputError):
    """A file is not what it says, is cut short, or holds no structured surface."""


class SwitchedOffError(FormatError):
    """A file is of a format that may not be read here, whatever is in it."""


class FormatWarning(UserWarning):
    """A file cannot say all of a surface, or does not say all that was needed; what was left out or assumed."""


class TooLargeError(InputError):
    """More bytes or vertices than allowed."""


class OptionError(InputError):
    """An option, level or format that does not exist, or a value that it does not take."""


class UnavailableError(LodestreamError):
    """What is needed is not here now, whatever was given: a library that is not installed, a process that was ended."""


class NotFoundError(LodestreamError, LookupError):
    """There is no such surface."""


class StreamError(LodestreamError):
    """The bytes of a container cannot be used."""


class CorruptStreamError(StreamError):
    """The bytes of a container are damaged.

    Attributes
    ----------
    offset : int
        Place in the container, in bytes from its start, of the part that failed its check.
    """

    def __init__(self, message: str, offset: int) -> None:
        super().__init__(f"{message} (at byte {offset})")
        self.offset = offset


class TruncatedStreamError(StreamError):
    """A container ends before what was asked for."""


class UnsupportedVersionError(StreamError):
    """A container or peer of another version than this program's."""


class ProtocolError(LodestreamError):
    """A message out of turn or out of shape."""


class LocalProtocolError(ProtocolError):
    """This side tried to send what the protocol does not allow now."""


class RemoteProtocolError(ProtocolError):
    """The other side sent what the protocol does not allow now."""


class RemoteError(LodestreamError):
    """The other side refused.

    Attributes
    ----------
    code : str
        Word from the table of error codes in ``docs/protocol.md``.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
