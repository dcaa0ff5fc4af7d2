"""What a key may be: a path that is the same in a folder, in a bucket, in an address and on every system.

No key may be the beginning of another one's path: in a folder, ``a`` and ``a/b`` cannot both be objects. Nor may two
keys differ in upper and lower case alone: to Windows and macOS they are one file.
"""

from __future__ import annotations

import re

from ..errors import InputError
from .interface import SMALL

__all__ = ["LONGEST_KEY", "LONGEST_PART", "PARTS", "checked_key", "checked_prefix", "checked_small", "is_key"]

#: Characters of a key. Buckets allow 1,024 with the prefix of a store.
LONGEST_KEY = 600
#: Characters of a part; file systems allow 255.
LONGEST_PART = 200

#: What the parts of a key are, for messages.
PARTS = (
    "parts between slashes are letters, digits and -_.=@,~ without a dot at either end, and no names that Windows "
    "keeps for itself (such as con, nul.json, a~1)"
)

# Not those that mean something in an address or to Windows. A leading dot is the store's own, and makes no `..`.
_PART = re.compile(r"[A-Za-z0-9_=@,~-]([A-Za-z0-9._=@,~-]*[A-Za-z0-9_=@,~-])?", re.ASCII)
# Devices, with any suffix, and short names that Windows gives to files of other names.
_OF_WINDOWS = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?|.*~[0-9].*", re.ASCII | re.IGNORECASE)


def is_key(key: str) -> bool:
    """Return whether a text can be a key."""
    return len(key) <= LONGEST_KEY and all(
        len(part) <= LONGEST_PART and _PART.fullmatch(part) and not _OF_WINDOWS.fullmatch(part)
        for part in key.split("/")
    )


def checked_key(key: str) -> str:
    """Return a key that can be one.

    Raises
    ------
    InputError
        If it cannot: it is empty or too long, has an empty part, a leading dot, a last dot, other characters than
        letters, digits and ``-_.=@,~``, or a name that Windows keeps for itself.
    """
    if not is_key(key):
        raise InputError(f"expected a key of at most {LONGEST_KEY} characters whose {PARTS}, got {key[:80]!r}")
    return key


def checked_prefix(prefix: str) -> str:
    """Return a prefix that can be one: nothing, or parts of keys with a slash at the end.

    Raises
    ------
    InputError
        If it cannot.
    """
    if prefix:
        if not prefix.endswith("/"):
            raise InputError(f"expected a prefix that ends with a slash, got {prefix[:80]!r}")
        checked_key(prefix[:-1])
    return prefix


def checked_small(key: str, data: bytes) -> bytes:
    """Return the bytes of a small object.

    Raises
    ------
    InputError
        If they are more than `SMALL`.
    """
    if len(data) > SMALL:
        raise InputError(f"expected at most {SMALL:,} bytes for {key}, got {len(data):,}")
    return data
