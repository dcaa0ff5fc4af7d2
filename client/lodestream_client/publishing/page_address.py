"""Where a published prefix is read, and what a bucket must allow for that."""

from __future__ import annotations

import json
import os
from urllib.parse import quote, urlsplit

from lodestream.page import INDEX
from lodestream.stores.connections import endpoint_of

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
    parts = urlsplit(address)
    key = "".join(f"{quote(part)}/" for part in parts.path.split("/") if part) + INDEX
    if parts.scheme == "s3":
        if endpoint := endpoint_of("s3"):
            return f"{endpoint.rstrip('/')}/{parts.netloc}/{key}"
        region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
        return f"https://{parts.netloc}.s3.{region}.amazonaws.com/{key}"
    if parts.scheme == "az":
        if endpoint := endpoint_of("az"):
            return f"{endpoint.rstrip('/')}/{parts.netloc}/{key}"
        account = os.environ.get("AZURE_STORAGE_ACCOUNT_NAME") or "ACCOUNT"
        return f"https://{account}.blob.core.windows.net/{parts.netloc}/{key}"
    if parts.scheme == "abfss":
        container, _, host = parts.netloc.partition("@")
        return f"https://{host.replace('.dfs.', '.blob.')}/{container}/{key}"
    return os.path.join(address, INDEX)


def cors_rule(address: str) -> str | None:
    """Return what lets pages of other origins read a bucket, as its tools take it; None of a folder."""
    scheme = urlsplit(address).scheme
    if scheme == "s3":
        rule = {
            "AllowedOrigins": ["*"],
            "AllowedMethods": _METHODS,
            "AllowedHeaders": _ALLOWED,
            "ExposeHeaders": _EXPOSED,
            "MaxAgeSeconds": _SECONDS,
        }
        bucket = urlsplit(address).netloc
        text = json.dumps({"CORSRules": [rule]})
        return f"aws s3api put-bucket-cors --bucket {bucket} --cors-configuration '{text}'"
    if scheme in ("az", "abfss"):
        allowed, exposed = " ".join(_ALLOWED), " ".join(_EXPOSED)
        return (
            f"az storage cors add --services b --origins '*' --methods {' '.join(_METHODS)} "
            f"--allowed-headers {allowed} --exposed-headers {exposed} --max-age {_SECONDS}"
        )
    return None
