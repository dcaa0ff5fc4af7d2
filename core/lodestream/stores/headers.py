"""What a bucket tells browsers and caches of an object, by its key."""

from __future__ import annotations

from mimetypes import MimeTypes

__all__ = ["headers"]

_IMMUTABLE = "public, max-age=31536000, immutable"
_NO_CACHE = "no-cache"  # kept, and asked for again with its tag

#: Types by the ending of a key, beside those that Python knows; what has none of them is only bytes.
_TYPES = {
    ".lode": "application/vnd.lodestream.container",
    ".js": "text/javascript; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".wasm": "application/wasm",
    ".woff2": "font/woff2",
    ".svg": "image/svg+xml",
}
_KNOWN = MimeTypes(filenames=())  # not those of the machine, which differ


def headers(key: str) -> dict[str, str]:
    """Return the headers of an object: its type, and how long it may be kept.

    Containers never change, and are kept for good. There is never a Content-Encoding: ranges are of the bytes as they
    are.
    """
    ending = key[key.rfind(".") :] if "." in key.rpartition("/")[2] else ""
    kind = _TYPES.get(ending) or _KNOWN.guess_type(key)[0] or "application/octet-stream"
    keep = _IMMUTABLE if key.startswith("containers/") and ending == ".lode" else _NO_CACHE
    return {"Content-Type": kind, "Cache-Control": keep}
