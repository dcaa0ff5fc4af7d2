"""The settings of a server: values of the table, checked, from the environment or from the caller; and its limits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from lodestream.capacity import memory_limit

from .bounds import Bounds
from .table import FORMATS, PREFIX, TABLE

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


class _Environment(EnvSettingsSource):
    """The environment, as far as the operator's settings go."""

    def __call__(self) -> dict[str, Any]:
        """Values by name."""
        return {name: value for name, value in super().__call__().items() if name in TABLE}


class Settings(BaseSettings, Bounds):
    """Settings of a server.

    Those of `lodestream_server.table` can also be set by environment variables with the prefix ``LODESTREAM_``; the
    others are its `Bounds`.
    """

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="forbid", env_ignore_empty=True)

    host: str = _field("host")
    port: int = _field("port")
    data: Path = _field("data")
    root_path: str = _field("root_path")
    trusted_proxies: Annotated[tuple[str, ...], NoDecode] = _field("trusted_proxies")
    insecure: bool = _field("insecure")
    token_file: Path | None = _field("token_file")
    public_reads: bool = _field("public_reads")
    origins: Annotated[tuple[str, ...], NoDecode] = _field("origins")
    formats: Annotated[tuple[str, ...], NoDecode] = _field("formats")
    upload_bytes: int = _field("upload_bytes")
    keep_free: int | None = _field("keep_free")
    workers: int = _field("workers")
    memory: int | None = _field("memory")
    log_format: str = _field("log_format")
    log_level: str = _field("log_level")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Ask whoever makes a server, then the environment."""
        return init_settings, _Environment(settings_cls)

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
        each = max(self._memory // self.workers, _LEAST_BUILD_MEMORY)
        return each if self.build_memory is None else self.build_memory

    @property
    def memory_of_levels(self) -> int:
        """Bytes of memory that the process that makes level files may use."""
        return max(self._memory // 2, _LEAST_LEVEL_MEMORY) if self.level_memory is None else self.level_memory

    @property
    def _memory(self) -> int:
        return memory_limit() // 2 if self.memory is None else self.memory
