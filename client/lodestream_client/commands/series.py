"""Surfaces of a file that holds several, for ``encode --each`` and ``push --each``: each is read by itself."""

from __future__ import annotations

import argparse
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..requests.local import checked_options
from .inputs import option_hints
from .surface_options import SurfaceOptions

if TYPE_CHECKING:
    from lodestream.formats.member import Member
    from lodestream.surface import Surface

__all__ = ["FILE", "EachFolder", "EachWord", "Part", "named_files", "parts"]

#: What `push` says where each file is a surface.
FILE = "file"

_WORD = re.compile(r"\w[\w-]*")
_UNSAFE = re.compile(r"[^\w.+-]+")

#: Most characters of a label in the name of a file, which may have 255 bytes.
_LONGEST_NAME = 50


class EachWord(argparse.Action):
    """``--each``, alone or with `FILE`, ``variable`` or the name of a dimension.

    argparse takes any word after it. One that is no name, or the name of a file, is put back before the files.
    """

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """Store the word, or the file name that it was."""
        word = FILE if values is None else str(values)
        if not option_has_value(word):
            namespace.first_file = [word]
            word = FILE
            _optional(parser, "url")
        setattr(namespace, self.dest, word)


class EachFolder(argparse.Action):
    """``--each WHAT=FOLDER``, with which there is no OUT."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        """Store the word and the folder."""
        setattr(namespace, self.dest, values)
        _optional(parser, "out")


def option_has_value(word: str) -> bool:
    """Return whether the word after ``--each`` is its value, not a file name."""
    return _WORD.fullmatch(word) is not None and not Path(word).exists()


def _optional(parser: argparse.ArgumentParser, dest: str) -> None:
    """Make an argument optional."""
    for action in parser._actions:  # argparse has no public way to change one
        if action.dest == dest:
            action.required = False


@dataclass(frozen=True)
class Part:
    """One of the surfaces of a file, and the options that read it."""

    member: Member
    options: SurfaceOptions
    series: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of its surface."""
        return f"{self.series['name']} {self.label}"

    @property
    def label(self) -> str:
        """Its name among the parts of the file."""
        return self.member.label

    def mark(self, surface: Surface) -> None:
        """Set name and place in the series in a surface's metadata."""
        from lodestream.series import SERIES

        surface.metadata["name"] = self.name
        surface.metadata[SERIES] = dict(self.series)


def parts(file: str, along: str, options: SurfaceOptions) -> list[Part]:
    """Return the surfaces of a file along a dimension, or its variables.

    Raises
    ------
    FormatError, OptionError
        If there are none, or an option does not fit.
    OSError
        If the file cannot be opened.
    """
    from lodestream.formats.series import members

    with option_hints((file,)):
        chosen = checked_options(options.format_options)
        listed = members(file, along, format_name=options.format_name, options=chosen)
    base = options.name or Path(file).stem
    return [
        Part(
            member,
            replace(options, name=None, format_options={**options.format_options, **member.options}),
            member.place(base).told(),
        )
        for member in listed
    ]


def named_files(surface_parts: Sequence[Part]) -> Iterator[tuple[Part, str]]:
    """Yield parts with names of their containers: their labels, all with their numbers where two are equal."""
    names = [_file_name(part) for part in surface_parts]
    # Some file systems take two spellings of a letter, or a large and a small one, for the same.
    if len({unicodedata.normalize("NFC", name).casefold() for name in names}) < len(names):
        names = [f"{name}-{part.member.index}" for part, name in zip(surface_parts, names, strict=True)]
    for part, name in zip(surface_parts, names, strict=True):
        yield part, f"{name}.lode"


def _file_name(part: Part) -> str:
    """Return the label without characters that file names cannot have.

    A minus sign stays, behind the name of the dimension: other programs take a name that begins with one for an option.
    """
    name = _UNSAFE.sub("-", part.label[:_LONGEST_NAME]).strip("-.")
    along = _UNSAFE.sub("-", part.member.along[:_LONGEST_NAME]).strip("-.") or "step"
    return f"{along}=-{name}" if name and part.label.startswith("-") else name or along
