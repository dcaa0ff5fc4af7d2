"""The settings of a server: values of the table, checked, from the environment or from the caller; and its limits."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field, field_validator, model_validator

from lodestream.container.capacity import memory_limit

from .bounds import Bounds
from .table import FORMATS, GONE, PREFIX, TABLE

__all__ = ["Settings"]


def _field(name: str) -> Any:
    setting = TABLE[name]
    default: dict[str, Any] = (
        {"default_factory": setting.default} if callable(setting.default) else {"default": setting.default}
    )
    return Field(description=setting.meaning, **default)


_LEAST_LEVEL_MEMORY = 1 << 30
# Python, the libraries and the kernels alone take a third of it.
_LEAST_BUILD_MEMORY = 512 << 20


class Settings(Bounds):
    """Settings of a server.

    Those of `lodestream_server.operation.table` can also be set by environment variables with the prefix
    ``LODESTREAM_``; the others are its `Bounds`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    host: str = _field("host")
    port: int = _field("port")
    data: Path = _field("data")
    root_path: str = _field("root_path")
    trusted_proxies: tuple[str, ...] = _field("trusted_proxies")
    insecure: bool = _field("insecure")
    unconfined: bool = _field("unconfined")
    token_file: Path | None = _field("token_file")
    public_reads: bool = _field("public_reads")
    origins: tuple[str, ...] = _field("origins")
    formats: tuple[str, ...] = _field("formats")
    upload_bytes: int = _field("upload_bytes")
    max_vertices: int = _field("max_vertices")
    keep_free: int | None = _field("keep_free")
    workers: int = _field("workers")
    threads: int | None = _field("threads")
    memory: int | None = _field("memory")
    dask: str = _field("dask")
    log_format: str = _field("log_format")
    log_level: str = _field("log_level")

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Return the given settings, completed from the environment; an empty variable counts as missing."""
        for name, replacement in GONE.items():
            if name in given or os.environ.get(PREFIX + name.upper()):
                raise ValueError(f"the setting {name} is gone: use {replacement}")
        variables = {name: os.environ.get(setting.variable) for name, setting in TABLE.items()}
        return {name: text for name, text in variables.items() if text} | given

    @field_validator(*TABLE, mode="before")
    @classmethod
    def _take(cls, value: Any, info: Any) -> Any:
        return TABLE[info.field_name].take(value)

    @field_validator("root_path")
    @classmethod
    def _rooted(cls, value: str) -> str:
        if value and (not value.startswith("/") or value.endswith("/")):
            raise ValueError(f"expected a path that begins with a slash and does not end with one, got {value!r}")
        return value

    @field_validator("formats")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not value or not set(value) <= set(FORMATS):
            raise ValueError(f"expected {TABLE['formats'].kind.expected}, got {', '.join(value) or 'none'}")
        return value

    @property
    def tokens(self) -> Path:
        """Path of the file with the token hashes, whether it exists or not."""
        return self.data / "tokens.json" if self.token_file is None else self.token_file

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
        return memory_limit() // 2 if self.memory is None else self.memory
