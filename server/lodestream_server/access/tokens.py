"""Tokens: a file with their hashes and scopes.

A token is 256 random bits, so a plain SHA-256 reveals nothing about it, and it cannot be guessed. The file::

    {"version": 1, "tokens": [{"name": "ci", "sha256": "...", "scopes": ["write"], "created": "...", "expires": null}]}
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from lodestream.errors import LodestreamError, NotFoundError, OptionError
from lodestream.operating_system import give_to_owner, lock

from ..store.durable import NewFile, remove, rename
from ..store.private import make_private

__all__ = ["SCOPES", "Token", "TokenFile", "Tokens"]

_log = logging.getLogger(__name__)

#: What a token may allow; each scope includes those before it. Reading: list, look, fetch, stream. Writing: upload and
#: delete. Admin: the metrics.
SCOPES = ("read", "write", "admin")

_VERSION = 1

# A word that finds the token again wherever it was left, in a repository for instance.
_PREFIX = "lode_"


@dataclass(frozen=True)
class Token:
    """The stored data of a token.

    Attributes
    ----------
    name : str
        Name that the operator gave it.
    sha256 : str
        Hash of the token, in hexadecimal digits.
    scopes : tuple of str
        Some of `SCOPES`, as given.
    created, expires : str or None
        Times (ISO 8601, UTC); None if it does not expire.
    """

    name: str
    sha256: str
    scopes: tuple[str, ...]
    created: str
    expires: str | None = None

    def allows(self, scope: str) -> bool:
        """Return whether one of the token's scopes is this one or includes it."""
        return any(SCOPES.index(given) >= SCOPES.index(scope) for given in self.scopes)

    @property
    def expired(self) -> bool:
        """Whether it has expired."""
        return self.expires is not None and datetime.now(UTC) >= datetime.fromisoformat(self.expires)

    @classmethod
    def from_json(cls, values: Any) -> Token:
        """Return a token from the values in a file; raises ValueError, TypeError or KeyError if they are invalid."""
        token = cls(
            str(values["name"]),
            bytes.fromhex(values["sha256"]).hex(),
            tuple(values["scopes"]),
            str(values["created"]),
            values.get("expires"),
        )
        if len(token.sha256) != 64 or not token.scopes or not set(token.scopes) <= set(SCOPES):
            raise ValueError(f"expected a SHA-256 and scopes out of {', '.join(SCOPES)}")
        if token.expires is not None and datetime.fromisoformat(token.expires).tzinfo is None:
            raise ValueError("expected a time with its offset from UTC")
        return token


class TokenFile:
    """The token file, as the command line reads and changes it.

    Parameters
    ----------
    path : Path
        The file need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> tuple[Token, ...]:
        """Return all tokens; none if there is no file.

        Raises
        ------
        LodestreamError
            If the file is not a token file.
        OSError
            If it cannot be read.
        """
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return ()
        try:
            document = json.loads(data)
            if document["version"] != _VERSION:
                raise LodestreamError(
                    f"expected version {_VERSION} of the token file {self.path}, got {document['version']!r}"
                )
            return tuple(Token.from_json(values) for values in document["tokens"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            why = f"{type(error).__name__}: {error}"  # its repr may hold all of the file
            raise LodestreamError(f"expected a token file, got {self.path}: {why}") from None

    def create(self, name: str, scopes: tuple[str, ...], days: float | None = None) -> tuple[str, Token]:
        """Add a token, and return the token itself, which is stored nowhere, and its stored data.

        Raises
        ------
        OptionError
            If a token has this name already.
        """
        now = datetime.now(UTC)
        text = _PREFIX + secrets.token_urlsafe(32)
        expires = None if days is None else (now + timedelta(days=days)).isoformat(timespec="seconds")
        token = Token(name, _digest(text), scopes, now.isoformat(timespec="seconds"), expires)
        with self._change() as tokens:
            if any(known.name == name for known in tokens):
                raise OptionError(f"expected a name that no token has yet, got {name!r}; revoke that one first")
            tokens.append(token)
        return text, token

    def revoke(self, name: str) -> None:
        """Remove a token; a running server notices at once.

        Raises
        ------
        NotFoundError
            If no token has this name.
        """
        with self._change() as tokens:
            kept = [token for token in tokens if token.name != name]
            if len(kept) == len(tokens):
                names = ", ".join(repr(token.name) for token in tokens) or "no tokens at all"
                raise NotFoundError(f"expected the name of a token, got {name!r}; there are {names}")
            tokens[:] = kept

    @contextmanager
    def _change(self) -> Iterator[list[Token]]:
        make_private(self.path.parent)
        with self._alone():
            tokens = list(self.load())
            yield tokens
            self._write(tokens)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        # A lock on the folder: the file is replaced, so a lock on it would be one on the old file.
        handle = os.open(self.path.parent, os.O_RDONLY)
        try:
            lock(handle, wait=True)
            yield
        finally:
            os.close(handle)

    def _write(self, tokens: list[Token]) -> None:
        document = {"version": _VERSION, "tokens": [asdict(token) for token in tokens]}
        new = self.path.with_name(f"{self.path.name}.{secrets.token_hex(8)}.new")
        with NewFile(new) as file:
            file.write(json.dumps(document, indent=1).encode() + b"\n")
        try:
            self._hand_over(new)
            rename(new, self.path)
        except OSError:
            remove(new)
            raise

    def _hand_over(self, new: Path) -> None:
        # Whoever the server runs as goes on reading the file, also when somebody else changes it.
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return
        give_to_owner(new, status)
        new.chmod(status.st_mode & 0o777)


class Tokens:
    """The tokens of a running server; follows changes of the file.

    Parameters
    ----------
    path : Path

    Raises
    ------
    LodestreamError, OSError
        If the file exists and cannot be used. If it becomes unusable later, no token is accepted.
    """

    def __init__(self, path: Path) -> None:
        self._file = TokenFile(path)
        self._state: tuple[int, ...] | None = self._look()
        self._tokens = self._file.load()
        self._met = bool(self._tokens)

    @property
    def used(self) -> bool:
        """Whether a token exists, or has existed while this server ran; from then on requests need one."""
        self._follow()
        return self._met

    def find(self, text: str) -> Token | None:
        """Return the token with this text, unless it has expired.

        The text is compared with all tokens in constant time, so that timing reveals nothing.
        """
        self._follow()
        digest = _digest(text)
        match = None
        for token in self._tokens:
            if hmac.compare_digest(token.sha256, digest):
                match = token
        return None if match is None or match.expired else match

    def known(self, sha256: str) -> Token | None:
        """Return the token with this hash, unless it was revoked or has expired."""
        self._follow()
        return next((token for token in self._tokens if token.sha256 == sha256 and not token.expired), None)

    def _follow(self) -> None:
        state = self._look()
        if state == self._state:
            return
        self._state = state
        try:
            self._tokens = self._file.load()
        except (LodestreamError, OSError) as error:
            self._tokens = ()
            self._met = True
            _log.error("no token is accepted until the token file is repaired: %s", error)
        self._met = self._met or bool(self._tokens)

    def _look(self) -> tuple[int, ...] | None:
        try:
            status = self._file.path.stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns, status.st_size


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()
