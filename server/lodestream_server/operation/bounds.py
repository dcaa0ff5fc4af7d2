"""Limits that follow from the machine and the settings, so that no operator has to choose them.

A program that starts a server by itself (`create_app`, `running_server`) may set them; the tests do.
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
    """Limits of a server. None: the value is computed when the server starts, as the description says."""

    upload_files: int = _count(64, "files in one upload")
    max_uploads: int = _count(64, "uploads in progress")
    max_partial_uploads: int = _count(256, "resumable uploads that are not complete")
    partial_seconds: float = _seconds(86400.0, "seconds for which a resumable upload is kept that nobody continues")
    max_surfaces: int = _count(100_000, "surfaces on the server")
    owner_bytes: int | None = _follows(
        1,
        "bytes on disk, uploads and containers, of one owner (a token's name, or all callers without a token "
        "together): half of what the owner has there plus what is free; no limit while only programs on this machine "
        "can write",
    )
    max_connections: int | None = _follows(
        1, "connections of all kinds: 5000, or fewer if the limit of open files (ulimit -n) does not allow as many"
    )
    max_streams: int = _count(
        2000, "open streams; as many connections may be waiting to authenticate, and as many requests for builds"
    )
    max_level_requests: int = _count(32, "requests for levels as files that wait at the same time")
    max_tile_requests: int = _count(64, "requests for tiles of maps that wait at the same time")
    level_memory: int | None = _follows(
        256 << 20, "memory of the process that makes a level as a file: half of `memory`, but at least 1 GiB"
    )
    level_disk: int | None = _follows(
        2 << 20,
        "disk space for levels as files, of which one file may use a quarter: 4 GiB, or a twentieth of the disk if "
        "that is less",
    )
    max_builds: int = _count(1000, "builds that wait or run")
    stream_memory: int | None = _follows(
        0,
        "extra send buffer, in bytes, that all streams share: a quarter of `memory`. Every stream has 256 KiB of its "
        "own; a fast one gets up to an eighth of what is left, at most 8 MiB",
    )
    build_memory: int | None = _follows(
        256 << 20,
        "memory of one build: `memory` divided by `workers`, but at least 512 MiB. The 250 MB of libraries that all "
        "builds share do not count",
    )
    build_seconds: float = _seconds(
        3600.0, "seconds that one build may take, by the clock, and in processor time for each of its threads"
    )
    level_seconds: float = _seconds(120.0, "seconds that making one level as a file may take")
    idle_seconds: float = _seconds(
        60.0, "seconds for which a client may send no part of an upload, be idle in a stream, or not read its answer"
    )
    least_rate: int = Field(
        default=1024,
        ge=0,
        description="least average rate, in bytes a second over each `idle_seconds`, at which a client must send an "
        "upload and read an answer; 0: any progress is enough",
    )
    head_seconds: float = _seconds(
        20.0, "seconds until the head of a request is complete, or until the token of a stream has arrived"
    )
    lease_seconds: float = _seconds(
        15.0, "seconds after which another server that shares a bucket takes over from one that has ended"
    )
    look_seconds: float = _seconds(
        3.0, "seconds between two looks at what other servers that share a bucket have changed, and at its tokens"
    )
    list_seconds: float = _seconds(600.0, "seconds between two lists of everything in a bucket")
    bye_seconds: float = _seconds(10.0, "seconds that the server waits for the client's bye after the end of a stream")
