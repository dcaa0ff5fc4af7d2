"""The settings of a server: the table's values, checked, from the environment or from whoever makes a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from .table import FORMATS, PREFIX, TABLE

__all__ = ["Settings"]


def _field(name: str) -> Any:
    setting = TABLE[name]
    default: dict[str, Any] = (
        {"default_factory": setting.default} if callable(setting.default) else {"default": setting.default}
    )
    return Field(description=setting.meaning, **default)


class Settings(BaseSettings):
    """Settings of a server; each is an environment variable with the prefix ``LODESTREAM_`` too.

    `lodestream_server.table` says what each of them means.
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
    upload_files: int = _field("upload_files")
    max_uploads: int = _field("max_uploads")
    max_vertices: int = _field("max_vertices")
    max_surfaces: int = _field("max_surfaces")
    keep_free: int | None = _field("keep_free")
    owner_bytes: int | None = _field("owner_bytes")
    max_connections: int | None = _field("max_connections")
    max_streams: int = _field("max_streams")
    max_client_streams: int = _field("max_client_streams")
    max_level_requests: int = _field("max_level_requests")
    max_client_level_requests: int = _field("max_client_level_requests")
    level_memory: int = _field("level_memory")
    level_disk: int | None = _field("level_disk")
    max_builds: int = _field("max_builds")
    workers: int = _field("workers")
    build_memory: int | None = _field("build_memory")
    build_seconds: float = _field("build_seconds")
    level_seconds: float = _field("level_seconds")
    idle_seconds: float = _field("idle_seconds")
    upload_rate: int = _field("upload_rate")
    head_seconds: float = _field("head_seconds")
    bye_seconds: float = _field("bye_seconds")
    log_format: str = _field("log_format")
    log_level: str = _field("log_level")

    @field_validator("*", mode="before")
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
        """The file of token hashes, whether or not there is one."""
        return self.data / "tokens.json" if self.token_file is None else self.token_file
