"""The settings of a server: one model, from which options, variables and the page of settings are made.

An operator chooses the fields of `Settings` itself, by options of ``lodestream serve`` or by variables with the prefix
``LODESTREAM_``; a program that starts a server may set its `Bounds` too.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_network
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ByteSize,
    Field,
    JsonValue,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from lodestream.errors import InputError

from .bounds import Bounds

__all__ = ["FORMATS", "GROUPS", "Choice", "Settings", "choices", "words_of"]

_PREFIX = "LODESTREAM_"

#: Settings of earlier versions, and what says the same now.
_GONE = {
    "upload_rate": "least_rate, which holds for uploads and for answers",
    "max_client_streams": "max_streams, of which each client leaves a share for the others",
}

#: The formats that a server can read: names of `lodestream.formats` (`Format.names`), `remesh` for meshes that are no
#: grids, and `lode` for containers.
FORMATS = (
    *("npy", "npz", "geotiff", "netcdf", "vmec", "png", "esri-ascii", "usgs-dem", "srtm-hgt", "ply", "stl", "off"),
    *("obj", "pcd", "vtk", "vts", "glb", "cgns", "text", "plot3d", "remesh", "lode"),
)

# Rare formats, and formats that almost any text fits: each reader that is off is one less that a hostile file can
# attack. Remeshing takes minutes.
_LEFT_OUT = ("usgs-dem", "vmec", "text", "remesh")

#: Groups of settings, and the heading of each.
GROUPS: Mapping[str, str] = {
    "network": "address, data folder, proxies",
    "access": "who may read and write",
    "limits": "formats, sizes, memory",
    "names": "names that stay",
    "operation": "log",
}

_LEAST_LEVEL_MEMORY = 1 << 30
# Python, the libraries and the kernels alone take a third of it.
_LEAST_BUILD_MEMORY = 512 << 20


def _processors() -> int:
    return max(1, (os.cpu_count() or 1) - 1)


def _parted(value: Any) -> Any:
    """Take a text apart at commas."""
    return tuple(filter(None, (part.strip() for part in value.split(",")))) if isinstance(value, str) else value


def _named(value: Any) -> Any:
    names = _parted(value)
    return FORMATS if names == ("all",) else names


def _known(names: tuple[str, ...]) -> tuple[str, ...]:
    if not names or not set(names) <= set(FORMATS):
        raise ValueError(f"expected all, or some of {', '.join(FORMATS)}, got {', '.join(names) or 'none'}")
    return names


def _place(value: Any) -> Any:
    if isinstance(value, str) and (not value or "\0" in value):
        raise ValueError("expected a path")
    return value


def _folder_or_bucket(value: Any) -> Any:
    """Return a folder as a path, and the address of a bucket as a text."""
    from lodestream.stores.addresses import place_of

    value = _place(value)
    if not isinstance(value, str):
        return value
    try:
        place = place_of(value)
    except InputError as error:
        raise ValueError(str(error)) from None
    return Path(value) if place is None else place.address


def _rooted(path: str) -> str:
    if path and (not path.startswith("/") or path.endswith("/")):
        raise ValueError("expected a path that begins with a slash and does not end with one")
    return path


def _scheduler(address: str) -> str:
    from lodestream.encoding.cluster import checked_address

    return checked_address(address) if address else address


def _size(value: Any) -> Any:
    """Read a number of bytes with its unit."""
    try:
        return int(TypeAdapter(ByteSize).validate_python(value)) if isinstance(value, str) else value
    except ValidationError:
        raise ValueError("expected bytes, such as 1000000 or 4GiB") from None


_SIZE = "SIZE"
_Size = Annotated[int, BeforeValidator(_size)]


def _networks(addresses: tuple[str, ...]) -> tuple[str, ...]:
    for address in addresses:
        try:
            ip_network(address, strict=False)
        except ValueError:
            raise ValueError(f"expected addresses or networks such as 10.0.0.0/8, got {address!r}") from None
    return addresses


def _origins(origins: tuple[str, ...]) -> tuple[str, ...]:
    for origin in origins:
        if origin not in ("*", "null") and not _ORIGIN.fullmatch(origin):
            raise ValueError(f"expected origins such as https://maps.example.org, or *, got {origin!r}")
    return origins


_ORIGIN = re.compile(r"[a-z][a-z0-9+.-]*://[^/?#@\s]+", re.IGNORECASE)
_Words = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_parted)]
_Formats = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_named), AfterValidator(_known)]
_Path = Annotated[Path, BeforeValidator(_place)]
_Data = Annotated[Path | str, BeforeValidator(_folder_or_bucket)]


def _choice(default: Any, group: str, meaning: str, *, metavar: str = "", usual: str = "", **limits: Any) -> Any:
    """Describe a field that an operator chooses.

    Parameters
    ----------
    default : value, or callable that returns it
    group : str
        Key of `GROUPS`.
    meaning : str
    metavar : str
        Placeholder for the value in the help of the command line.
    usual : str
        The default in words, if it depends on the machine.
    limits : ge, le, allow_inf_nan
    """
    given = {"default_factory": default} if callable(default) else {"default": default}
    shown: dict[str, JsonValue] = {"group": group, "metavar": metavar, "usual": usual}
    return Field(description=meaning, json_schema_extra=shown, **given, **limits)


class _Environment(EnvSettingsSource):
    """The variables of what an operator chooses: bounds are no business of the environment."""

    def __call__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__call__().items() if name not in Bounds.model_fields}


class Settings(BaseSettings, Bounds):
    """Settings of a server."""

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", validate_default=True, env_prefix=_PREFIX, env_ignore_empty=True
    )

    host: str = _choice("127.0.0.1", "network", "address to listen on", metavar="H")
    port: int = _choice(8000, "network", "port to listen on; 0 takes a free one", metavar="P", ge=0, le=65535)
    data: _Data = _choice(
        Path("lodestream-data"),
        "network",
        "data folder, which holds uploads and containers, or a bucket for them, such as s3://bucket/prefix, which any "
        "number of servers may share",
        metavar="DIR",
    )
    read_only: bool = _choice(
        False,
        "network",
        "only read what another server writes to the bucket of the data: nothing is uploaded, built or deleted here",
    )
    scratch: _Path | None = _choice(
        None,
        "network",
        "folder on a local disk, in which the server makes its folder lodestream for what it can make again: the index "
        "of the surfaces, uploads and builds in progress, levels as files",
        metavar="DIR",
        usual="scratch in the data folder; lodestream-scratch where the data are in a bucket",
    )
    root_path: Annotated[str, AfterValidator(_rooted)] = _choice(
        "",
        "network",
        "path under which a reverse proxy serves this server, such as /maps; the proxy must remove it from requests",
        metavar="PATH",
        usual="none",
    )
    trusted_proxies: Annotated[_Words, AfterValidator(_networks)] = _choice(
        (),
        "network",
        "addresses or networks of reverse proxies whose X-Forwarded-For and X-Forwarded-Proto headers are trusted",
        metavar="A,B",
        usual="none",
    )
    insecure: bool = _choice(
        False,
        "access",
        "allow an address that others can reach although no token exists: until there is one, anyone who reaches the "
        "port may read, upload and delete",
    )
    unconfined: bool = _choice(
        False,
        "access",
        "start although this system or its kernel cannot confine the processes that read uploads (Landlock and seccomp "
        "of Linux): a file that exploits a bug in its reader may then do what the server may do. "
        "Without it `lodestream serve` refuses to start; a server that a program starts (`create_app`, "
        "`running_server`) logs a warning",
    )
    token_file: _Path | None = _choice(
        None,
        "access",
        "file with the hashes of the tokens, written by `lodestream token`",
        metavar="FILE",
        usual="tokens.json in the data folder or the bucket",
    )
    public_reads: bool = _choice(False, "access", "allow anyone to list, fetch and stream surfaces without a token")
    origins: Annotated[_Words, AfterValidator(_origins)] = _choice(
        (),
        "access",
        "origins of other web sites whose pages may use this server, such as https://maps.example.org; * allows all "
        "sites, and requires that a token exists",
        metavar="A,B",
        usual="none",
    )
    formats: _Formats = _choice(
        tuple(name for name in FORMATS if name not in _LEFT_OUT),
        "limits",
        f"file formats that the server reads: all, or some of {', '.join(FORMATS)} (vmec are the NetCDF files of VMEC, "
        "remesh are meshes that are no grids, which ?remesh=yes resamples, lode are containers)",
        metavar="A,B",
        usual=f"all but {', '.join(_LEFT_OUT)}",
    )
    upload_bytes: _Size = _choice(4 << 30, "limits", "largest upload", metavar=_SIZE, ge=1)
    max_vertices: int = _choice(1 << 28, "limits", "vertices of one surface", ge=1)
    keep_free: _Size | None = _choice(
        None,
        "limits",
        "disk space that uploads and levels as files leave free",
        metavar=_SIZE,
        usual="1GiB, or a twentieth of the disk if that is less",
        ge=0,
    )
    cache_bytes: _Size | None = _choice(
        None,
        "limits",
        "disk space of the scratch folder for containers of a bucket: one that is read a second time is fetched whole "
        "if it takes at most half of that, one of which levels or tiles are made if it takes at most all of it",
        metavar=_SIZE,
        usual="16GiB, or a tenth of the disk if that is less",
        ge=0,
    )
    workers: int = _choice(
        _processors,
        "limits",
        "number of builds that run at the same time",
        usual="the number of processors less one",
        ge=1,
    )
    threads: int | None = _choice(
        None,
        "limits",
        "threads of each build, and of the process that makes levels as files",
        usual="the number of processors divided by that of builds at the same time, at least 1",
        ge=1,
        le=256,
    )
    memory: _Size | None = _choice(
        None,
        "limits",
        "memory that all running builds together may use; the process that makes levels as files may use half as much "
        "in addition, and the one that makes tiles of maps 512 MiB",
        metavar=_SIZE,
        usual="half of the machine's memory",
        ge=256 << 20,
    )
    dask: Annotated[str, AfterValidator(_scheduler)] = _choice(
        "",
        "limits",
        "address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers build what is too large for the "
        "memory of one build; they must see the scratch folder under the same path",
        metavar="ADDRESS",
        usual="none",
    )
    keep_replaced_days: float = _choice(
        1.0,
        "names",
        "days for which a surface stays that another one has replaced under its name; then the server deletes it",
        metavar="DAYS",
        ge=0,
        le=36500,
        allow_inf_nan=False,
    )
    log_format: Literal["text", "json"] = _choice("text", "operation", "format of the log on standard error")
    log_level: Literal["debug", "info", "warning", "error"] = _choice(
        "info", "operation", "least severe messages that are logged"
    )
    log_reads: bool = _choice(
        False,
        "operation",
        "log requests that read at level info, as those that write; otherwise at debug",
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Take what a program gives, then what the environment says."""
        return init_settings, _Environment(settings_cls)

    @model_validator(mode="before")
    @classmethod
    def _refuse_gone(cls, given: Any) -> Any:
        for name, replacement in _GONE.items():
            if name in given or os.environ.get(_PREFIX + name.upper()):
                raise ValueError(f"the setting {name} is gone: use {replacement}")
        return given

    @property
    def memory_of_build(self) -> int:
        """Bytes of memory that one build may use."""
        share = max(self._memory // self.workers, _LEAST_BUILD_MEMORY)
        return share if self.build_memory is None else self.build_memory

    @property
    def threads_of_build(self) -> int:
        """Threads of one build, and of the process that makes level files."""
        return max((os.cpu_count() or 1) // self.workers, 1) if self.threads is None else self.threads

    @property
    def memory_of_levels(self) -> int:
        """Bytes of memory that the process that makes level files may use."""
        return max(self._memory // 2, _LEAST_LEVEL_MEMORY) if self.level_memory is None else self.level_memory

    @property
    def memory_of_streams(self) -> int:
        """Bytes that all streams together may have in send buffers, beside the fixed share of each."""
        return self._memory // 4 if self.stream_memory is None else self.stream_memory

    @property
    def _memory(self) -> int:
        from lodestream.container.capacity import memory_limit  # which needs numpy; the command line does not

        return memory_limit() // 2 if self.memory is None else self.memory


@dataclass(frozen=True)
class Choice:
    """A field of `Settings` that an operator chooses, as options and pages show it.

    Attributes
    ----------
    name : str
    field : FieldInfo
    """

    name: str
    field: FieldInfo

    @property
    def variable(self) -> str:
        """Name of the environment variable."""
        return _PREFIX + self.name.upper()

    @property
    def option(self) -> str:
        """Name of the option on the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def meaning(self) -> str:
        """What it is, in a line or a few."""
        return self.field.description or ""

    @property
    def group(self) -> str:
        """Key of `GROUPS`."""
        return self._shown("group")

    @property
    def metavar(self) -> str:
        """Placeholder for the value in the help of the command line."""
        return self._shown("metavar") or "N"

    @property
    def words(self) -> tuple[str, ...]:
        """The words of which one is chosen; none if it is no such choice."""
        return get_args(self.field.annotation) if get_origin(self.field.annotation) is Literal else ()

    @property
    def is_switch(self) -> bool:
        """Whether it is yes or no."""
        return self.field.annotation is bool

    @property
    def default_text(self) -> str:
        """The default, for help texts."""
        return self._shown("usual") or self._text(self.field.default)

    @property
    def limits(self) -> str:
        """The values that are allowed, for help texts; empty if there are no limits that need to be said."""
        if self.words:
            return f"one of {', '.join(self.words)}"
        found = {type(limit).__name__: limit for limit in self.field.metadata}
        least = getattr(found.get("Ge"), "ge", None)
        most = getattr(found.get("Le"), "le", None)
        if not least and most is None:
            return ""
        return f"at least {self._text(least)}" if most is None else f"{self._text(least)} to {self._text(most)}"

    def take(self, text: str) -> Any:
        """Return the value that a text stands for.

        Raises
        ------
        ValueError
            If it stands for none, in words for a user.
        """
        try:
            kind: Any = Annotated[self.field.annotation, self.field]
            return TypeAdapter(kind).validate_python(text)
        except ValidationError as error:
            raise ValueError(self.words_of(error)) from None

    def words_of(self, error: ValidationError) -> str:
        """Return what is wrong with a value, in a line for a user."""
        first = error.errors()[0]
        expected = {
            "bool_parsing": "yes or no",
            "int_parsing": "a whole number",
            "float_parsing": "a number",
            "finite_number": "a number",
            "greater_than_equal": self.limits or "0 or more",
            "less_than_equal": self.limits,
            "literal_error": self.limits,
        }.get(first["type"])
        return words_of(error) if expected is None else f"expected {expected}, got {first['input']!r:.200}"

    def _shown(self, key: str) -> str:
        shown = self.field.json_schema_extra
        return str(shown[key]) if isinstance(shown, dict) else ""

    def _text(self, value: Any) -> str:
        if self.is_switch:
            return "yes" if value else "no"
        if self.metavar == _SIZE and value > 1:
            return ByteSize(value).human_readable().replace(".0", "")
        return f"{value:g}" if isinstance(value, float) else str(value)


def choices() -> dict[str, Choice]:
    """Return what an operator chooses, by name, in the order of the manual."""
    fields = Settings.model_fields.items()
    return {name: Choice(name, field) for name, field in fields if name not in Bounds.model_fields}


def words_of(error: ValidationError) -> str:
    """Return the first thing that is wrong with a value, in a line."""
    first = error.errors()[0]
    if first["type"] == "value_error":
        words = first["msg"].removeprefix("Value error, ")
        return words if ", got " in words or not isinstance(first["input"], str) else f"{words}, got {first['input']!r}"
    return f"{first['msg'][0].lower()}{first['msg'][1:]}, got {first['input']!r:.200}"
