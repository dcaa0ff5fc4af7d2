"""What an operator may choose, in one table: name, default, limits and meaning."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

__all__ = ["Settings"]


class Settings(BaseSettings):
    """Settings of a server; each can be given as an environment variable with the prefix ``LODESTREAM_``."""

    model_config = SettingsConfigDict(env_prefix="LODESTREAM_", frozen=True, extra="forbid")

    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    insecure: bool = Field(
        default=False, description="listen on an address that others can reach, without access control"
    )
    data: Path = Field(default=Path("lodestream-data"), description="folder of uploads and containers")
    upload_bytes: int = Field(default=4 << 30, ge=1, description="most bytes of one upload")
    upload_files: int = Field(default=64, ge=1, description="most files of one upload")
    max_vertices: int = Field(default=1 << 28, ge=1, description="most vertices of one surface")
    workers: int = Field(
        default_factory=lambda: max(1, (os.cpu_count() or 1) - 1), ge=1, description="builds at the same time"
    )
    build_seconds: float = Field(default=3600.0, gt=0, description="longest time of one build")
    idle_seconds: float = Field(
        default=60.0, gt=0, description="longest silence of a stream's client before it is closed"
    )
    bye_seconds: float = Field(default=10.0, gt=0, description="longest wait for a client's bye after the end")
