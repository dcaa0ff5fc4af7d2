"""Where a published prefix is read, and what a bucket must allow for that."""

from __future__ import annotations

import json
import os
from urllib.parse import quote

from lodestream.page import INDEX
from lodestream.stores.addresses import place_of
from lodestream.stores.connections import Place, endpoint_of

__all__ = ["cors_rule", "page_address"]

_METHODS = ["GET", "HEAD"]
_ALLOWED = ["range", "if-range", "if-none-match"]
_EXPOSED = ["content-range", "content-length", "etag", "accept-ranges"]
_SECONDS = 86400


def page_address(address: str, public_url: str | None) -> str:
    """Return the address of the page of a published prefix.

    Parameters
    ----------
    address : str
        Of the store: a folder, or a URL.
    public_url : str or None
        Where its objects are read; None: at the store's own address.
    """
    if public_url is not None:
        return f"{public_url.rstrip('/')}/{INDEX}"
    place = place_of(address)
    return os.path.join(address, INDEX) if place is None else f"{_host(place)}/{quote(place.prefix)}{INDEX}"


def _host(place: Place) -> str:
    """Return the URL of a bucket, by path: the certificate of a host is not for names with dots before it."""
    if endpoint := endpoint_of(place.scheme):
        host = endpoint.rstrip("/")
    elif place.scheme == "s3":
        region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
        if "." not in place.bucket:
            return f"https://{place.bucket}.s3.{region}.amazonaws.com"
        host = f"https://s3.{region}.amazonaws.com"
    else:
        account = place.account or os.environ.get("AZURE_STORAGE_ACCOUNT_NAME") or "ACCOUNT"
        host = f"https://{account}.blob.core.windows.net"
    return f"{host}/{place.bucket}"


def cors_rule(address: str) -> str | None:
    """Return what lets pages of other origins read a bucket, as its tools take it; None of a folder."""
    place = place_of(address)
    if place is None:
        return None
    if place.scheme == "s3":
        rule = {
            "AllowedOrigins": ["*"],
            "AllowedMethods": _METHODS,
            "AllowedHeaders": _ALLOWED,
            "ExposeHeaders": _EXPOSED,
            "MaxAgeSeconds": _SECONDS,
        }
        text = json.dumps({"CORSRules": [rule]})
        return f"aws s3api put-bucket-cors --bucket {place.bucket} --cors-configuration '{text}'"
    allowed, exposed = " ".join(_ALLOWED), " ".join(_EXPOSED)
    return (
        f"az storage cors add --services b --origins '*' --methods {' '.join(_METHODS)} "
        f"--allowed-headers {allowed} --exposed-headers {exposed} --max-age {_SECONDS}"
    )
