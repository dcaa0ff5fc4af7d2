"""What follows from the machine and the settings: bounds that no operator has to choose.

A program that starts a server by itself (`create_app`, `running_server`) may choose others; the tests do.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

__all__ = ["Bounds"]


def _count(value: int, meaning: str) -> Any:
    return Field(value, ge=1, description=meaning)


def _seconds(value: float, meaning: str) -> Any:
    return Field(value, gt=0, allow_inf_nan=False, description=meaning)


def _follows(least: int, meaning: str) -> Any:
    return Field(None, ge=least, description=meaning)


class Bounds(BaseModel):
    """Bounds of a server; None where the value follows from what there is at the start, as its description says."""

    upload_files: int = _count(64, "files of one upload")
    max_uploads: int = _count(64, "uploads at the same time")
    max_vertices: int = _count(1 << 28, "vertices of one surface")
    max_surfaces: int = _count(100_000, "surfaces")
    owner_bytes: int | None = _follows(
        1,
        "bytes on the disk, of uploads and containers, of one token's name, or of all those without a token together: "
        "as much as stays free beside them; no limit where only this machine can write",
    )
    max_connections: int | None = _follows(
        1, "connections of all kinds: 5000, or as many as the limit of open files (ulimit -n) is enough for"
    )
    max_streams: int = _count(
        2000, "streams at the same time, and beside them as many connections that have yet to show a token"
    )
    max_client_streams: int = _count(1000, "streams at the same time of one token, or without one of one address")
    max_level_requests: int = _count(32, "requests for levels that wait at the same time")
    max_client_level_requests: int = _count(
        16, "requests for levels of one client at the same time, counted until the answer has been read"
    )
    level_memory: int | None = _follows(
        256 << 20, "memory of the process that makes levels as files, one at a time: half of `memory`, at least 1 GiB"
    )
    level_disk: int | None = _follows(
        2 << 20,
        "disk space for levels as files, of which one may take a quarter: 4 GiB, or a twentieth of the disk if that is "
        "less",
    )
    max_builds: int = _count(1000, "builds that wait or run")
    build_memory: int | None = _follows(256 << 20, "memory of one build: `memory` divided by `workers`")
    build_seconds: float = _seconds(3600.0, "time of one build, and its processor time")
    level_seconds: float = _seconds(120.0, "time in which one level is made")
    idle_seconds: float = _seconds(
        60.0, "silence of a client, in a stream, an upload or an answer that it does not take"
    )
    upload_rate: int = Field(
        default=1024, ge=0, description="least bytes a second of an upload, over each stretch of `idle_seconds`"
    )
    head_seconds: float = _seconds(20.0, "time in which the head of a request has to come, or the token of a stream")
    bye_seconds: float = _seconds(10.0, "wait for a client's bye after the end of a stream")
