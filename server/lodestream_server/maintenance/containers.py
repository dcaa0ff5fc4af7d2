"""Checking a container that is read once, and describing it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace

from lodestream.container import FrameReader, read_index
from lodestream.errors import LodestreamError, UnsupportedVersionError
from lodestream.stores import Store, StoreError

from ..builds.finished import ERRORS, figures_of
from ..store import layout
from ..store.layout import Summary

__all__ = ["check_container", "digest_of", "errors_of"]


def check_container(
    store: Store, sha256: str, told: Callable[[Iterator[bytes]], Iterable[bytes]] = lambda chunks: chunks
) -> tuple[str, str | None, str | None]:
    """Return the state of a container, what is wrong with it, and a hash of its description.

    Parameters
    ----------
    store : Store
    sha256 : str
        By which it is called.
    told : callable
        Passes its chunks on.
    """
    key = layout.container_key(sha256)
    frames, digest = FrameReader(keeps=()), hashlib.sha256()
    place: LodestreamError | None = None
    try:
        for chunk in told(store.pieces(key)):
            digest.update(chunk)
            if place is None:
                try:
                    for _ in frames.feed(chunk):
                        pass
                except LodestreamError as error:
                    place = error
        if digest.hexdigest() != sha256:
            where = f"; {place}" if place else ""
            return "bad", f"expected bytes with the SHA-256 of the name, got {digest.hexdigest()}{where}", None
        if place is not None:
            raise place
        with store.open(key) as blob:
            index = read_index(blob.read, blob.size)
            return "whole", None, digest_of(blob.size, *layout.describe(figures_of(index, None, ())))
    except StoreError as error:
        return "unreadable", str(error), None
    except UnsupportedVersionError as error:
        return "version", str(error), None
    except LodestreamError as error:
        return "bad", str(error), None


def errors_of(info: bytes) -> str | None:
    """Return who vouches for the errors that a description has."""
    errors = json.loads(info or b"{}").get(ERRORS)
    return errors if errors is None else str(errors)


def digest_of(size: int, info: bytes, summary: Summary) -> str:
    """Return a hash of a description, but for what no container says: who vouches for the errors, and the thumbnail."""
    figures = json.loads(info or b"{}")
    figures.pop(ERRORS, None)
    told = asdict(replace(summary, thumbnail=None))
    return hashlib.sha256(json.dumps([size, figures, told], sort_keys=True).encode()).hexdigest()
