"""What an operator may choose, in one table: name, default, limits and meaning.

`settings` reads it from the environment, `command` offers it on the command line, `docs/settings.md` is written from
it. Nothing heavy is imported here: the command line's parser is made from this table, whatever the command.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["FORMATS", "GROUPS", "PREFIX", "TABLE", "Kind", "Setting"]

#: What the names of environment variables begin with.
PREFIX = "LODESTREAM_"

#: The formats that a server can read, by the names of `lodestream.formats` (`Format.names`), and containers themselves.
FORMATS = (
    "npy",
    "npz",
    "geotiff",
    "netcdf",
    "vmec",
    "png",
    "esri-ascii",
    "usgs-dem",
    "srtm-hgt",
    "ply",
    "off",
    "obj",
    "pcd",
    "vtk",
    "vts",
    "cgns",
    "bpt",
    "text",
    "plot3d",
    "lode",
)

# Rare, or so loose that almost any text is one: each reader less is one less that strangers' files can go wrong in.
_LEFT_OUT = ("usgs-dem", "bpt", "vmec", "text")

_UNITS = {"": 1} | {letter: 1000**power for power, letter in enumerate("kmgt", 1)}
_UNITS |= {f"{letter}i": 1024**power for power, letter in enumerate("kmgt", 1)}
_TRUE, _FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off")


@dataclass(frozen=True)
class Kind:
    """How a value is written.

    Attributes
    ----------
    expected : str
        What it has to be, in words.
    metavar : str
        What stands for it in a command line.
    parse : callable
        From text to the value; ValueError when the text is none.
    show : callable
        From the value to text that `parse` takes.
    """

    expected: str
    metavar: str
    parse: Callable[[str], Any]
    show: Callable[[Any], str] = str


def _size(text: str) -> int:
    found = re.fullmatch(r"(\d{1,18})(\.\d{1,9})? ?([a-z]{0,3})", text.lower(), re.ASCII)
    unit = None if found is None else _UNITS.get(found[3].removesuffix("b"))
    if found is None or unit is None:
        raise ValueError
    size: int = int(found[1]) * unit + round(float(found[2] or 0) * unit)
    return size


def _show_size(size: int) -> str:
    for power, letter in reversed(tuple(enumerate("KMGT", 1))):
        if size and size % 1024**power == 0:
            return f"{size // 1024**power}{letter}iB"
    return str(size)


def _switch(text: str) -> bool:
    if text.lower() not in _TRUE + _FALSE:
        raise ValueError
    return text.lower() in _TRUE


def _path(text: str) -> Path:
    if not text or "\0" in text:
        raise ValueError
    return Path(text)


def _list(text: str) -> tuple[str, ...]:
    return tuple(filter(None, (part.strip() for part in text.split(","))))


def _formats(text: str) -> tuple[str, ...]:
    names = _list(text)
    if names == ("all",):
        return FORMATS
    if not names or not set(names) <= set(FORMATS):
        raise ValueError
    return names


def _choice(*words: str) -> Kind:
    def parse(text: str) -> str:
        if text not in words:
            raise ValueError
        return text

    return Kind(f"one of {', '.join(words)}", "{" + ",".join(words) + "}", parse)


_TEXT = Kind("text", "TEXT", str)
_INTEGER = Kind("an integer", "N", int)
_SIZE = Kind("bytes, such as 1000000 or 4GiB", "SIZE", _size, _show_size)
_SWITCH = Kind("yes or no", "", _switch, lambda value: "yes" if value else "no")
_PATH = Kind("a path", "PATH", _path)
_LIST = Kind("words separated by commas", "A,B", _list, ",".join)
_FORMATS = Kind(f"all, or names out of {', '.join(FORMATS)} with commas between", "A,B", _formats, ",".join)


@dataclass(frozen=True)
class Setting:
    """One thing that an operator may choose.

    Attributes
    ----------
    name : str
        Field of `Settings`; upper case and with `PREFIX` a variable of the environment; with hyphens an option.
    kind : Kind
    default : value, or callable that gives it
    meaning : str
        What it is, in a line.
    group : str
        Key of `GROUPS`.
    least, most : number or None
        Limits, themselves allowed.
    metavar : str
        What stands for the value on the command line; the kind's own if empty.
    usual : str
        What the default is, in words, where it is not the same everywhere.
    """

    name: str
    kind: Kind
    default: Any
    meaning: str
    group: str
    least: float | None = None
    most: float | None = None
    metavar: str = ""
    usual: str = ""

    @property
    def variable(self) -> str:
        """The variable of the environment."""
        return PREFIX + self.name.upper()

    @property
    def option(self) -> str:
        """The option of the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def default_text(self) -> str:
        """The default, in words."""
        return self.usual or self.kind.show(self.default)

    @property
    def limits(self) -> str:
        """The limits, in words; empty if there are none."""
        if not self.least and self.most is None:
            return ""
        least = self.kind.show(self.least)
        return f"at least {least}" if self.most is None else f"{least} to {self.kind.show(self.most)}"

    def take(self, value: Any) -> Any:
        """The value that some text stands for, or the value itself, once it is within the limits.

        Raises
        ------
        ValueError
            When it is not.
        """
        if isinstance(value, str):
            try:
                value = self.kind.parse(value)
            except ValueError:
                raise ValueError(f"expected {self.kind.expected}, got {value!r}") from None
        if isinstance(value, int | float) and not isinstance(value, bool) and not self._within(value):
            limits = self.limits or "at least 0"
            raise ValueError(f"expected {self.kind.expected}, {limits}, got {value}")
        return value

    def _within(self, value: float) -> bool:
        # Written so that NaN is outside.
        return (self.least is None or value >= self.least) and (self.most is None or value <= self.most)


def _processors() -> int:
    return max(1, (os.cpu_count() or 1) - 1)


#: The groups of settings, and what they are about.
GROUPS: Mapping[str, str] = {
    "network": "where the server listens, and how it is reached",
    "access": "who may do what",
    "limits": "how much is taken",
    "operation": "what the operator sees",
}

_SETTINGS = (
    Setting("host", _TEXT, "127.0.0.1", "address to listen on", "network", metavar="H"),
    Setting("port", _INTEGER, 8000, "port to listen on; 0 takes a free one", "network", 0, 65535, metavar="P"),
    Setting("data", _PATH, Path("lodestream-data"), "folder of uploads and containers", "network", metavar="DIR"),
    Setting(
        "root_path",
        _TEXT,
        "",
        "path under which a reverse proxy shows this server, such as /maps; the proxy takes it off",
        "network",
        metavar="PATH",
        usual="none",
    ),
    Setting(
        "trusted_proxies",
        _LIST,
        (),
        "addresses or networks of reverse proxies whose X-Forwarded-For and X-Forwarded-Proto are believed",
        "network",
        metavar="A,B",
        usual="none",
    ),
    Setting(
        "insecure",
        _SWITCH,
        False,
        "serve without tokens on an address that others can reach: while there is no token, whoever reaches the port "
        "may read, upload and delete",
        "access",
    ),
    Setting(
        "token_file",
        _PATH,
        None,
        "file of token hashes, as `lodestream token` writes it",
        "access",
        metavar="FILE",
        usual="tokens.json in the data folder",
    ),
    Setting("public_reads", _SWITCH, False, "let anyone list, look at and stream surfaces without a token", "access"),
    Setting(
        "origins",
        _LIST,
        (),
        "origins of other sites whose pages may use this server, such as https://maps.example.org; * is all of them, "
        "which needs a token to be there",
        "access",
        metavar="A,B",
        usual="none",
    ),
    Setting(
        "formats",
        _FORMATS,
        tuple(name for name in FORMATS if name not in _LEFT_OUT),
        f"formats of files that are read: all, or names out of {', '.join(FORMATS)} (VMEC is a kind of NetCDF)",
        "limits",
        usual=f"all but {', '.join(_LEFT_OUT)}",
    ),
    Setting("upload_bytes", _SIZE, 4 << 30, "most bytes of one upload", "limits", 1),
    Setting(
        "keep_free",
        _SIZE,
        None,
        "disk space that uploads leave free",
        "limits",
        0,
        usual="1GiB, or a twentieth of the disk if that is less",
    ),
    Setting(
        "workers",
        _INTEGER,
        _processors,
        "builds at the same time",
        "limits",
        1,
        usual="one less than there are processors",
    ),
    Setting(
        "memory",
        _SIZE,
        None,
        "most memory of all builds together; beside them, the process that makes levels as files may take half as much",
        "limits",
        256 << 20,
        usual="half of the memory there is",
    ),
    Setting("log_format", _choice("text", "json"), "text", "how the log is written to standard error", "operation"),
    Setting(
        "log_level",
        _choice("debug", "info", "warning", "error"),
        "info",
        "what is worth a line in the log",
        "operation",
    ),
)

#: The settings by name, in the order in which they are shown.
TABLE: Mapping[str, Setting] = {setting.name: setting for setting in _SETTINGS}
