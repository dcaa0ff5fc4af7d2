"""From the address of a store to the store."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ..errors import InputError
from .bucket import Bucket
from .connections import SCHEMES
from .folder import Folder
from .interface import Store

__all__ = ["open_store"]

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://", re.ASCII)  # one letter is a drive of Windows


def open_store(address: str | os.PathLike[str]) -> Store:
    """Open a store.

    Parameters
    ----------
    address : str or Path
        A folder, which need not exist yet, or a bucket: ``s3://bucket/prefix``, ``az://container/prefix`` or
        ``abfss://container@account.dfs.core.windows.net/prefix``. Credentials, region and endpoint of a bucket come
        from the environment (``AWS_*``, ``AZURE_*``) or from the machine's role.

    Raises
    ------
    InputError
        If it is no such address, or has a credential, a query or a fragment.
    UnavailableError
        If the library for buckets is not installed.
    StoreError
        If credentials, region or account of a bucket are missing.
    """
    if not os.fspath(address):
        raise InputError("expected a folder or the address of a bucket, got nothing")
    scheme = _SCHEME.match(address) if isinstance(address, str) else None
    if not isinstance(address, str) or scheme is None:
        return Folder(Path(address))
    if scheme[1].lower() not in SCHEMES:
        raise InputError(
            f"expected a folder or an address that begins with {', '.join(f'{name}://' for name in SCHEMES)}, got one "
            f"that begins with {scheme[1].lower()}://"
        )
    return Bucket(address)
