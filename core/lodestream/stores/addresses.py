"""From the address of a store to the store."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..errors import InputError
from .bucket import Bucket
from .connections import SCHEMES, Limits, Place, parsed
from .folder import Folder
from .interface import Store

__all__ = ["open_store", "place_of"]

# One letter is a drive of Windows. With one slash, or none, a bucket is meant that would become a folder unnoticed.
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(/?)", re.ASCII)


def open_store(address: str | os.PathLike[str], limits: Limits | None = None, *, fetched: Path | None = None) -> Store:
    """Open a store.

    Parameters
    ----------
    address : str or Path
        A folder, which need not exist yet, or a bucket: ``s3://bucket/prefix``, ``az://container/prefix`` or
        ``abfss://container@account.dfs.core.windows.net/prefix``. Credentials, region and endpoint of a bucket come
        from the environment (``AWS_*``, ``AZURE_*``) or from the machine's role.
    limits : Limits, optional
        How long a bucket is waited for.
    fetched : Path, optional
        Folder, which is there, for the files that `Store.local` makes of objects in a bucket.

    Raises
    ------
    InputError
        If it is no such address, or has a credential, a query or a fragment.
    UnavailableError
        If the library for buckets is not installed.
    StoreError
        If credentials, region or account of a bucket are missing.
    """
    return Folder(Path(address)) if place_of(address) is None else Bucket(os.fspath(address), limits, fetched=fetched)


def place_of(address: str | os.PathLike[str]) -> Place | None:
    """Return where the bucket of an address is, without opening it; None: the address is a folder.

    What is refused is not repeated, since it may be a credential.

    Raises
    ------
    InputError
        If it is no address of a store.
    """
    if not os.fspath(address):
        raise InputError("expected a folder or the address of a bucket, got nothing")
    scheme = _SCHEME.match(address) if isinstance(address, str) else None
    if not isinstance(address, str) or scheme is None:
        return None
    return parsed(address) if scheme[2] or scheme[1].lower() in SCHEMES else None
