"""The table of settings that an operator may choose: name, default, limits and meaning of each.

`settings` reads their values from the environment, `command` makes options of the command line from the table, and
`docs/settings.md` is generated from it. This module imports nothing heavy, because the command line's parser needs it
for every command.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodestream.sizes import parse_size

__all__ = ["FORMATS", "GONE", "GROUPS", "PREFIX", "TABLE", "Kind", "Setting"]

#: Prefix of the environment variables.
PREFIX = "LODESTREAM_"

#: Settings of earlier versions, and what says the same now.
GONE = {
    "upload_rate": "least_rate, which holds for uploads and for answers",
    "max_client_streams": "max_streams, of which each client leaves a share for the others",
}

#: The formats that a server can read: names of `lodestream.formats` (`Format.names`), `remesh` for meshes that are no
#: grids, and `lode` for containers.
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
    "stl",
    "off",
    "obj",
    "pcd",
    "vtk",
    "vts",
    "glb",
    "cgns",
    "text",
    "plot3d",
    "remesh",
    "lode",
)

# Rare formats, and formats that almost any text fits: each reader that is off is one less that a hostile file can
# attack. Remeshing takes minutes.
_LEFT_OUT = ("usgs-dem", "vmec", "text", "remesh")

_TRUE, _FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off")


@dataclass(frozen=True)
class Kind:
    """The type of a setting: how its values are parsed and shown.

    Attributes
    ----------
    expected : str
        The values that are allowed, for error messages.
    metavar : str
        Placeholder for the value in the help of the command line.
    parse : callable
        Converts text to the value; raises ValueError if the text is not valid.
    show : callable
        Converts the value to text that `parse` accepts.
    """

    expected: str
    metavar: str
    parse: Callable[[str], Any]
    show: Callable[[Any], str] = str


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


def _scheduler(text: str) -> str:
    # Here, as nothing of the library is needed for other commands.
    from lodestream.encoding.cluster import checked_address

    return checked_address(text) if text else text


def _choice(*words: str) -> Kind:
    def parse(text: str) -> str:
        if text not in words:
            raise ValueError
        return text

    return Kind(f"one of {', '.join(words)}", "{" + ",".join(words) + "}", parse)


_TEXT = Kind("text", "TEXT", str)
_INTEGER = Kind("an integer", "N", int)
_SIZE = Kind("bytes, such as 1000000 or 4GiB", "SIZE", parse_size, _show_size)
_SWITCH = Kind("yes or no", "", _switch, lambda value: "yes" if value else "no")
_PATH = Kind("a path", "PATH", _path)
_LIST = Kind("words separated by commas", "A,B", _list, ",".join)
_SCHEDULER = Kind("the address of a Dask scheduler such as tcp://10.0.0.1:8786", "ADDRESS", _scheduler)
_FORMATS = Kind(f"all, or some of {', '.join(FORMATS)}, separated by commas", "A,B", _formats, ",".join)


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes
    ----------
    name : str
        Name of the field of `Settings`. The environment variable is this name in upper case after `PREFIX`; the option
        of the command line has hyphens in place of underscores.
    kind : Kind
    default : value, or callable that returns it
    meaning : str
        One line for help texts and the manual.
    group : str
        Key of `GROUPS`.
    least, most : number or None
        Smallest and largest value allowed.
    metavar : str
        Placeholder for the value in the help of the command line; that of the kind if empty.
    usual : str
        The default in words, if it depends on the machine.
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
        """Name of the environment variable."""
        return PREFIX + self.name.upper()

    @property
    def option(self) -> str:
        """Name of the option on the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def default_text(self) -> str:
        """The default, for help texts."""
        return self.usual or self.kind.show(self.default)

    @property
    def limits(self) -> str:
        """The limits, for help texts; empty if there are none."""
        if not self.least and self.most is None:
            return ""
        least = self.kind.show(self.least)
        return f"at least {least}" if self.most is None else f"{least} to {self.kind.show(self.most)}"

    def take(self, value: Any) -> Any:
        """Parse a text, or take a value as it is, and check the limits.

        Raises
        ------
        ValueError
            When the text is not valid, or the value is outside the limits.
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


#: Groups of settings, and the heading of each.
GROUPS: Mapping[str, str] = {
    "network": "address, data folder, proxies",
    "access": "who may read and write",
    "limits": "formats, sizes, memory",
    "operation": "log",
}

_SETTINGS = (
    Setting("host", _TEXT, "127.0.0.1", "address to listen on", "network", metavar="H"),
    Setting("port", _INTEGER, 8000, "port to listen on; 0 takes a free one", "network", 0, 65535, metavar="P"),
    Setting(
        "data",
        _PATH,
        Path("lodestream-data"),
        "data folder, which holds uploads and containers",
        "network",
        metavar="DIR",
    ),
    Setting(
        "root_path",
        _TEXT,
        "",
        "path under which a reverse proxy serves this server, such as /maps; the proxy must remove it from requests",
        "network",
        metavar="PATH",
        usual="none",
    ),
    Setting(
        "trusted_proxies",
        _LIST,
        (),
        "addresses or networks of reverse proxies whose X-Forwarded-For and X-Forwarded-Proto headers are trusted",
        "network",
        metavar="A,B",
        usual="none",
    ),
    Setting(
        "insecure",
        _SWITCH,
        False,
        "allow an address that others can reach although no token exists: until there is one, anyone who reaches the "
        "port may read, upload and delete",
        "access",
    ),
    Setting(
        "unconfined",
        _SWITCH,
        False,
        "start although this system or its kernel cannot confine the processes that read uploads (Landlock and seccomp "
        "of Linux): a file that exploits a bug in its reader may then do what the server may do. "
        "Without it `lodestream serve` refuses to start; a server that a program starts (`create_app`, "
        "`running_server`) logs a warning",
        "access",
    ),
    Setting(
        "token_file",
        _PATH,
        None,
        "file with the hashes of the tokens, written by `lodestream token`",
        "access",
        metavar="FILE",
        usual="tokens.json in the data folder",
    ),
    Setting(
        "public_reads", _SWITCH, False, "allow anyone to list, fetch and stream surfaces without a token", "access"
    ),
    Setting(
        "origins",
        _LIST,
        (),
        "origins of other web sites whose pages may use this server, such as https://maps.example.org; * allows all "
        "sites, and requires that a token exists",
        "access",
        metavar="A,B",
        usual="none",
    ),
    Setting(
        "formats",
        _FORMATS,
        tuple(name for name in FORMATS if name not in _LEFT_OUT),
        f"file formats that the server reads: all, or some of {', '.join(FORMATS)} (vmec are the NetCDF files of VMEC, "
        "remesh are meshes that are no grids, which ?remesh=yes resamples, lode are containers)",
        "limits",
        usual=f"all but {', '.join(_LEFT_OUT)}",
    ),
    Setting("upload_bytes", _SIZE, 4 << 30, "largest upload", "limits", 1),
    Setting("max_vertices", _INTEGER, 1 << 28, "vertices of one surface", "limits", 1),
    Setting(
        "keep_free",
        _SIZE,
        None,
        "disk space that uploads and levels as files leave free",
        "limits",
        0,
        usual="1GiB, or a twentieth of the disk if that is less",
    ),
    Setting(
        "workers",
        _INTEGER,
        _processors,
        "number of builds that run at the same time",
        "limits",
        1,
        usual="the number of processors less one",
    ),
    Setting(
        "threads",
        _INTEGER,
        None,
        "threads of each build, and of the process that makes levels as files",
        "limits",
        1,
        256,
        usual="the number of processors divided by that of builds at the same time, at least 1",
    ),
    Setting(
        "memory",
        _SIZE,
        None,
        "memory that all running builds together may use; the process that makes levels as files may use half as much "
        "in addition",
        "limits",
        256 << 20,
        usual="half of the machine's memory",
    ),
    Setting(
        "dask",
        _SCHEDULER,
        "",
        "address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers build what is too large for the "
        "memory of one build; they must see the data folder under the same path",
        "limits",
        usual="none",
    ),
    Setting("log_format", _choice("text", "json"), "text", "format of the log on standard error", "operation"),
    Setting(
        "log_level",
        _choice("debug", "info", "warning", "error"),
        "info",
        "least severe messages that are logged",
        "operation",
    ),
)

#: The settings by name, in the order of the manual.
TABLE: Mapping[str, Setting] = {setting.name: setting for setting in _SETTINGS}
