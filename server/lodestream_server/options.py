"""The query of an upload: the surface options, and what can be said of an upload at once."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream import Tolerance
from lodestream.errors import FormatError, OptionError

from .worker import ATTRIBUTE, CLOSED, UNNAMED

if TYPE_CHECKING:
    from lodestream.formats import Format

__all__ = ["SurfaceOptions", "check", "identify", "plain_name"]

_LONGEST_NAME = 255


@dataclass(frozen=True)
class SurfaceOptions:
    """The options of a surface.

    Attributes
    ----------
    name : str or None
        What the surface is to be called.
    filename : str or None
        Name of the file, where the body does not tell it.
    chosen : mapping of str to str
        ``precision`` and ``rms`` in one spelling, ``precision=NAME`` for attributes, ``closed`` unless it is auto, and
        options of the format as they came: what makes another surface of the same bytes.
    """

    name: str | None
    filename: str | None
    chosen: dict[str, str]

    @classmethod
    def parse(cls, query: Iterable[tuple[str, str]]) -> SurfaceOptions:
        """Read a query; what is not an option of every surface is taken for one of the format.

        Raises
        ------
        OptionError
            When a value is not one that its option takes, an option stands there twice, or both a precision and a root
            mean square error of the points do.
        """
        values: dict[str, str] = {}
        for key, value in query:
            if "=" in key:
                raise OptionError(f"expected the name of an option, got {key[:80]!a}")
            if key == "precision":
                # A name may hold an equals sign, a tolerance does not.
                attribute, equals, value = value.rpartition("=")
                key, value = key + equals + attribute, str(Tolerance.parse(value))
            elif key == "rms":
                value = str(Tolerance.parse(value))
            if key in values:
                raise OptionError(f"expected {key[:80]!a} once, got it twice")
            values[key] = value
        if "precision" in values and "rms" in values:
            raise OptionError("expected either a precision or a root mean square error, got both")
        name, filename = plain_name(values.pop("name", "")), plain_name(values.pop("filename", ""))
        closed = values.pop("closed", "auto")
        if closed not in CLOSED:
            raise OptionError(f"expected closed to be one of {', '.join(CLOSED)}, got {closed[:80]!a}")
        if closed != "auto":
            values["closed"] = closed
        return cls(name, filename, values)


def check(files: list[Path], names: list[str | None], options: SurfaceOptions) -> Format:
    """Refuse what a look at the first bytes shows to be wrong; the first file's format.

    Raises
    ------
    FormatError
        When a file is of no format that can be read.
    OptionError
        When the format has no such option.
    """
    from lodestream.formats import formats, sniff

    found = [sniff(file, filename=name or UNNAMED) for file, name in zip(files, names, strict=True)]
    for format_ in found:
        if format_.read is None:
            readable = ", ".join(item.name for item in formats() if item.read)
            raise FormatError(f"expected a file of format {readable}, got {format_.name}, which is only written")
    for key in options.chosen:
        if key not in ("precision", "rms", "closed", *found[0].options) and not key.startswith(ATTRIBUTE):
            known = ", ".join(("precision", "rms", "closed", "name", "filename", *found[0].options))
            raise OptionError(f"expected one of {known} for format {found[0].name}, got {key[:80]!a}")
    return found[0]


def identify(digest: hashlib._Hash, format_: Format, filename: str | None, options: SurfaceOptions) -> str:
    """The id of a surface: 20 hexadecimal digits of SHA-256 over the upload's bytes, its format and its options.

    What the name of the first file tells, like the place of an .hgt, counts as an option; the name itself does not.
    """
    told = dict(format_.named(filename)) if format_.named and filename else {}
    whole = digest.copy()
    whole.update(json.dumps([format_.name, sorted({**told, **options.chosen}.items())], ensure_ascii=True).encode())
    return whole.hexdigest()[:20]


def plain_name(text: str) -> str | None:
    """A name as it is shown to people: the last part of a path, and nothing that could upset a terminal."""
    name = "".join(character for character in text.replace("\\", "/").rpartition("/")[2] if character.isprintable())
    return name[:_LONGEST_NAME].strip() or None
