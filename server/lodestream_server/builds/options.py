"""The query of an upload: the surface options, and early checks of an upload."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import OptionError, SwitchedOffError
from lodestream.quality import Quality

from . import finished
from .stored_quality import ATTRIBUTE, stored
from .worker import ALLOWED_BY, CLOSED, UNNAMED

if TYPE_CHECKING:
    from lodestream.formats import Format

__all__ = ["SurfaceOptions", "check", "identify", "plain_name", "printable"]

_LONGEST_NAME = 255

# Of all formats; the last two say nothing of how a surface is made.
_OURS = ("precision", "rms", "effort", "closed", "nodata", "name", "filename")


@dataclass(frozen=True)
class SurfaceOptions:
    """The options of a surface.

    Attributes
    ----------
    name : str or None
        Name of the surface.
    filename : str or None
        Name of the file, if the body has none.
    chosen : mapping of str to str
        The options that distinguish surfaces made from the same bytes: ``precision`` and ``rms`` in canonical spelling,
        ``precision=NAME`` of attributes, ``effort`` unless it is default, ``closed`` unless it is auto, ``nodata`` as a
        number, and options of the format as given.
    """

    name: str | None
    filename: str | None
    chosen: dict[str, str]

    @classmethod
    def parse(cls, query: Iterable[tuple[str, str]]) -> SurfaceOptions:
        """Parse a query; whether the options of formats fit the file's is for `check` to say.

        Raises
        ------
        OptionError
            If there is no such option, a value is invalid, an option is given twice, or both a precision and a root
            mean square error of the points are given.
        """
        from lodestream.formats import formats

        of_formats = {key for format_ in formats() for key in format_.options}
        values: dict[str, str] = {}
        precisions = []
        for key, value in query:
            if "=" in key:
                raise OptionError(f"There is no option {key[:80]!a}: no name of one has an equals sign")
            if key not in _OURS and key not in of_formats:
                known = f"{', '.join(_OURS)} and, of some formats, {', '.join(sorted(of_formats))}"
                raise OptionError(f"There is no option {key[:80]!a}, only {known}")
            if key == "precision":
                precisions.append(value)
                continue
            if key == "attributes" and key in values:
                values[key] += f",{value}"  # a list, as of the text with commas
                continue
            if key in values:
                raise OptionError(f"The option {key[:80]!a} is given twice")
            values[key] = value
        values |= stored(Quality.parse(precisions, values.pop("rms", None), values.pop("effort", Quality.effort)))
        name, filename = plain_name(values.pop("name", "")), plain_name(values.pop("filename", ""))
        closed = values.pop("closed", "auto")
        if closed not in CLOSED:
            raise OptionError(f"The option closed is one of {', '.join(CLOSED)}, and not {closed[:80]!a}")
        if closed != "auto":
            values["closed"] = closed
        if "nodata" in values:
            from lodestream.formats.nodata import checked

            values["nodata"] = str(checked(values["nodata"]))
        return cls(name, filename, values)


def check(
    files: list[Path],
    names: list[str | None],
    options: SurfaceOptions,
    allowed: Collection[str] | None = None,
) -> Format:
    """Check an upload as far as its first bytes allow, and return the format of its first file.

    Parameters
    ----------
    files : list of Path
    names : list of (str or None)
        Original names of the files.
    options : SurfaceOptions
    allowed : collection of str or None
        Names of the formats that this server reads; None: all.

    Raises
    ------
    FormatError
        If the format of a file is unknown.
    SwitchedOffError
        If this server does not read the format of the first file, which decides about the others.
    OptionError
        If the format has no such option.
    """
    from lodestream.formats import sniff

    if any(map(finished.is_container, files)):
        _check_allowed(("lode",), names[0], allowed)
        return finished.check_upload(files, options.chosen)
    sniffed = [sniff(file, filename=name or UNNAMED) for file, name in zip(files, names, strict=True)]
    _check_allowed(sniffed[0].names, names[0], allowed)
    for key in options.chosen:
        if key not in (*_OURS, *sniffed[0].options) and not key.startswith(ATTRIBUTE):
            known = ", ".join((*_OURS, *sniffed[0].options))
            raise OptionError(f"The format {sniffed[0].name} has no option {key[:80]!a}, only {known}")
    if options.chosen.get("remesh") is not None:
        _check_allowed(("remesh",), names[0], allowed)
    return sniffed[0]


def _check_allowed(formats: Sequence[str], filename: str | None, allowed: Collection[str] | None) -> None:
    from lodestream.formats import check_allowed

    try:
        check_allowed(formats, allowed)
    except SwitchedOffError as error:
        raise SwitchedOffError(f"{filename or UNNAMED}: {error} {ALLOWED_BY}") from None


def identify(
    digest: hashlib._Hash, format_: Format, filename: str | None, options: SurfaceOptions, owner: str | None
) -> str:
    """Return the id of a surface: 20 hexadecimal digits of a SHA-256.

    It covers the upload's bytes, format, options, name and owner. What the name of the first file implies, such as the
    position of an .hgt, counts as an option; the file's name itself does not count.
    """
    implied = dict(format_.named(filename)) if format_.named and filename else {}
    whole = digest.copy()
    words: list[object] = [format_.name, sorted({**implied, **options.chosen}.items())]
    # Nobody's surface without a name keeps the id that earlier versions gave it.
    if options.name is not None or owner is not None:
        words += [options.name, owner]
    whole.update(json.dumps(words, ensure_ascii=True).encode())
    return whole.hexdigest()[:20]


def plain_name(text: str) -> str | None:
    """Return a name for display: the last part of a path, without characters that are unsafe on a terminal."""
    return printable(text.replace("\\", "/").rpartition("/")[2])


def printable(text: str) -> str | None:
    """Return a name without characters that are unsafe on a terminal; names come from strangers' containers too."""
    return "".join(character for character in text if character.isprintable())[:_LONGEST_NAME].strip() or None
