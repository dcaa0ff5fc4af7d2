"""The Range header: which requests for parts of a file are accepted.

The framework's file response handles ranges. Headers that it would answer in plain text, or should not see at all, are
handled here first. A header that is not a list of byte ranges, or has very many of them, is ignored, as RFC 9110 (14.2)
allows.
"""

from __future__ import annotations

import re

from fastapi import Request
from starlette.exceptions import HTTPException

__all__ = ["only_range", "sort_out"]

_MOST = 16
_RANGE = re.compile(r"\s*(\d{1,18})-(\d{1,18})?\s*|\s*-(\d{1,18})\s*")


def sort_out(request: Request, size: int, etag: str) -> None:
    """Remove the Range header of a request that is to be answered with the whole file.

    Raises
    ------
    HTTPException
        416 if the client requests bytes beyond the end.
    """
    header = request.headers.get("range")
    if header is None:
        return
    unit, _, text = header.partition("=")
    ranges = [_RANGE.fullmatch(part) for part in text.split(",", _MOST)]
    usable = unit.strip().lower() == "bytes" and len(ranges) <= _MOST and all(map(_ordered, ranges))
    if not usable or request.headers.get("if-range", etag) != etag:
        request.scope["headers"] = [(name, value) for name, value in request.scope["headers"] if name != b"range"]
        return
    for requested in ranges:
        if requested is not None and (int(requested[1]) >= size if requested[1] else int(requested[3]) == 0):
            raise HTTPException(
                416,
                f"The file has {size} bytes, and not the range {requested[0].strip()}",
                {"content-range": f"bytes */{size}"},
            )


def only_range(request: Request, size: int) -> tuple[int, int] | None:
    """Return where the only range begins and ends that is asked for, after `sort_out`; None: all is to be sent."""
    ranges = request.headers.get("range", "").partition("=")[2].split(",")
    wanted = _RANGE.fullmatch(ranges[0]) if len(ranges) == 1 else None
    if wanted is None:
        return None
    if wanted[3]:
        return max(size - int(wanted[3]), 0), size
    return int(wanted[1]), min(int(wanted[2]) + 1, size) if wanted[2] else size


def _ordered(requested: re.Match[str] | None) -> bool:
    return requested is not None and not (requested[1] and requested[2] and int(requested[2]) < int(requested[1]))
