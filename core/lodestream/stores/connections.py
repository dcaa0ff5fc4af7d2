"""Connections to buckets: their addresses, and what the environment says of credentials and endpoints."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from .keys import PARTS, is_key

if TYPE_CHECKING:
    from obstore.store import ClientConfig, ObjectStore, RetryConfig

__all__ = ["LONGEST_PAUSE", "SCHEMES", "Limits", "Place", "connected", "endpoint_of", "parsed"]

#: Schemes of addresses, and how each is written.
SCHEMES = {
    "s3": "s3://bucket/prefix",
    "az": "az://container/prefix",
    "abfss": "abfss://container@account.dfs.core.windows.net/prefix",
}
_BEGINNINGS = ", ".join(f"{scheme}://" for scheme in SCHEMES)

_S3_BUCKET = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{1,61}[A-Za-z0-9]", re.ASCII)
_CONTAINER = re.compile(r"[a-z0-9](?:[a-z0-9-]{1,61})[a-z0-9]|\$web", re.ASCII)
# The first one that is set.
_S3_ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
_AZURE_ENDPOINTS = ("AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT")
#: Characters of a prefix: with the longest key below what stores allow.
_LONGEST_PREFIX = 300
_ENDPOINT = re.compile(
    r"https?://(?:[a-z0-9_.-]+|\[[0-9a-f:.]+\])(?::[0-9]{1,5})?(?:/[a-z0-9._~/-]*)?", re.ASCII | re.IGNORECASE
)
_ACCOUNT = re.compile(r"([a-z0-9]{3,24})\.(?:dfs|blob)\.core\.windows\.net", re.ASCII)


#: Seconds between two attempts at most.
LONGEST_PAUSE = 2.0


@dataclass(frozen=True)
class Limits:
    """How long a store is waited for.

    Attributes
    ----------
    stalled : float
        Seconds until the answer to a request begins, or continues.
    request : float
        Seconds of a whole request, also the time in which a request that failed is made again.
    part : float
        Seconds of a request that writes a part of a large object.
    retries : int
        How often the library makes a request that failed again.
    again : float
        Seconds after which a call that failed, with its retries, is not made once more.
    pause : float
        Seconds until what failed is made again for the first time; then about twice as many each time, up to 2.
    delete : float
        Seconds of a request that deletes. It has no condition, so the library never makes it again.
    """

    stalled: float = 10.0
    request: float = 20.0
    part: float = 120.0
    retries: int = 3
    again: float = 10.0
    pause: float = 0.05
    delete: float = 5.0


@dataclass(frozen=True)
class Place:
    """Where a store is.

    Attributes
    ----------
    scheme : str
    bucket : str
        Of Azure, the container.
    account : str or None
        Of Azure, if the address has it.
    prefix : str
        Nothing, or with a slash at the end.
    """

    scheme: str
    bucket: str
    account: str | None
    prefix: str

    @property
    def address(self) -> str:
        """The address, without a slash at its end."""
        account = f"@{self.account}.dfs.core.windows.net" if self.account else ""
        return f"{self.scheme}://{self.bucket}{account}/{self.prefix}".rstrip("/")


def parsed(address: str) -> Place:
    """Take an address apart; what is refused is not repeated, since it may be a credential.

    Raises
    ------
    InputError
        If it is no address of a bucket, or has more in it than bucket and prefix.
    """
    scheme, separated, rest = address.partition("://")
    scheme = scheme.lower()
    if not separated or scheme not in SCHEMES:
        name, _, behind = scheme.partition(":")
        if not separated and behind and name in SCHEMES:
            lacking = "a slash is" if behind.startswith("/") else "two slashes are"
            raise InputError(
                f"{lacking} missing after {name}:, expected an address such as {SCHEMES[name]}; put ./ before a folder "
                "or file with a colon in its name"
            )
        advice = "" if separated else ": put ./ before a folder with a colon in its name"
        raise InputError(f"expected a folder or an address that begins with {_BEGINNINGS}, got another one{advice}")
    host, _, prefix = rest.partition("/")
    if "?" in rest or "#" in rest:
        raise InputError(f"expected an address such as {SCHEMES[scheme]}, got one with a query or fragment")
    user, at, host = host.rpartition("@")
    account = None
    if scheme == "abfss":
        bucket, known = user, _ACCOUNT.fullmatch(host)
        account = known[1] if known else None
        right = account is not None and _CONTAINER.fullmatch(bucket) is not None
    elif at or ":" in host:
        raise InputError(
            f"expected an address such as {SCHEMES[scheme]}, got one with credentials or a port: credentials come from "
            "the environment (AWS_..., AZURE_...), and so does the endpoint"
        )
    else:
        bucket, right = host, (_S3_BUCKET if scheme == "s3" else _CONTAINER).fullmatch(host) is not None
    if not right:
        raise InputError(
            f"expected an address such as {SCHEMES[scheme]}, got another bucket, container or account: their names "
            "have 3 to 63 small letters, digits and hyphens"
        )
    prefix = prefix.strip("/")
    if prefix and (len(prefix) > _LONGEST_PREFIX or not is_key(prefix)):
        raise InputError(f"expected a prefix of at most {_LONGEST_PREFIX} characters whose {PARTS}, got another one")
    return Place(scheme, bucket, account, f"{prefix}/" if prefix else "")


def endpoint_of(scheme: str) -> str | None:
    """Return the endpoint that the environment names for buckets of a scheme; None: that of Amazon or Azure.

    Raises
    ------
    InputError
        If it is no address of a service, or has a credential in it.
    """
    names = _S3_ENDPOINTS if scheme == "s3" else _AZURE_ENDPOINTS
    name = next((name for name in names if os.environ.get(name)), None)
    if name is None:
        return None
    if any(each in os.environ[name] for each in "@?#"):
        raise InputError(f"expected the address of a service in {name}, got one with credentials, a query or fragment")
    if not _ENDPOINT.fullmatch(os.environ[name]):
        raise InputError(
            f"expected the address of a service in {name}, such as http://127.0.0.1:9000, got another text"
        )
    return os.environ[name]


def connected(place: Place, limits: Limits, stalled: float, seconds: float) -> ObjectStore:
    """Connect to a bucket with what the environment says; nothing is asked yet."""
    from obstore.store import AzureStore, S3Store

    endpoint = endpoint_of(place.scheme)
    client: ClientConfig = {
        "timeout": timedelta(seconds=seconds),
        "read_timeout": timedelta(seconds=stalled),
        "connect_timeout": timedelta(seconds=min(limits.stalled, 5.0)),
        "allow_http": endpoint is not None and endpoint.lower().startswith("http://"),
    }
    retry: RetryConfig = {
        "max_retries": limits.retries,
        "retry_timeout": timedelta(seconds=seconds),
        "backoff": {
            "init_backoff": timedelta(seconds=limits.pause),
            "max_backoff": timedelta(seconds=LONGEST_PAUSE),
            "base": 2,
        },
    }
    settings: dict[str, Any] = {"client_options": client, "retry_config": retry}
    if endpoint is not None:
        settings["endpoint"] = endpoint
    if place.scheme == "s3":
        return S3Store(place.bucket, **settings)
    if place.account is not None:
        settings["account_name"] = place.account
    return AzureStore(place.bucket, **settings)
