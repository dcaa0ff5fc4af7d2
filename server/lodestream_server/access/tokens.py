"""Tokens: a file with their hashes and scopes; where the data are in a bucket, an object there, which readers share.

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
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError, NotFoundError, OptionError
from lodestream.operating_system import give_to_owner, lock
from lodestream.stores import AbsentError, Store, Tag, open_store

from ..store.durable import NewFile, remove, rename
from ..store.private import make_private

if TYPE_CHECKING:
    from ..operation.settings import Settings

__all__ = ["SCOPES", "Token", "TokenFile", "TokenList", "TokenObject", "Tokens", "tokens_of"]

_log = logging.getLogger(__name__)

#: What a token may allow; each scope includes those before it. Reading: list, look, fetch, stream. Writing: upload and
#: delete. Admin: the metrics.
SCOPES = ("read", "write", "admin")

#: Name of the file in a data folder, and key in a bucket.
TOKENS = "tokens.json"

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


class TokenList(ABC):
    """Where the hashes of tokens are, as the command line reads and changes them, and a server follows them.

    Attributes
    ----------
    place : str
        For people.
    """

    place: str

    @abstractmethod
    def load(self) -> tuple[Token, ...]:
        """Return all tokens; none if there is no list.

        Raises
        ------
        LodestreamError
            If it is no list of tokens.
        OSError
            If it cannot be read.
        """

    @abstractmethod
    def state(self) -> object:
        """Return what tells this state of the list from others, as far as it is known without a request; None: none."""

    @abstractmethod
    def _change(self) -> AbstractContextManager[list[Token]]:
        """Give the tokens for the length of a block, and store what it has made of them."""

    @abstractmethod
    def look(self) -> None:
        """Look what there is now, if that takes a request.

        Raises
        ------
        StoreError
            If the store cannot be read; what was known stays so.
        """

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
        """Remove a token; a running server notices at once, those of a bucket within seconds.

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

    def _parse(self, data: bytes) -> tuple[Token, ...]:
        try:
            document = json.loads(data)
            if document["version"] != _VERSION:
                raise LodestreamError(
                    f"expected version {_VERSION} of the token file {self.place}, got {document['version']!r}"
                )
            return tuple(Token.from_json(values) for values in document["tokens"])
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            why = f"{type(error).__name__}: {error}"  # its repr may hold all of the file
            raise LodestreamError(f"expected a token file, got {self.place}: {why}") from None


def _document(tokens: list[Token], **more: str) -> bytes:
    document = {"version": _VERSION, "tokens": [asdict(token) for token in tokens], **more}
    return json.dumps(document, indent=1).encode() + b"\n"


class TokenFile(TokenList):
    """Tokens in a file.

    Parameters
    ----------
    path : Path
        The file need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.place = str(path)

    def load(self) -> tuple[Token, ...]:
        """Return all tokens; none if there is no file."""
        try:
            data = self.path.read_bytes()
        except FileNotFoundError:
            return ()
        return self._parse(data)

    def state(self) -> object:
        """Return what tells this state of the file from others."""
        try:
            status = self.path.stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns, status.st_size

    def look(self) -> None:
        """Do nothing: `state` looks at the file each time."""

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
        new = self.path.with_name(f"{self.path.name}.{secrets.token_hex(8)}.new")
        with NewFile(new) as file:
            file.write(_document(tokens))
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


class TokenObject(TokenList):
    """Tokens in a bucket, for all servers that share it. What is there is known as of the last `look`.

    Parameters
    ----------
    store : Store
        It is looked at once.

    Raises
    ------
    StoreError
        If it cannot be read.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._found: tuple[bytes, Tag] | None = None
        self.place = f"{TOKENS} in {store.describe()}"
        self.look()

    def look(self) -> None:
        """Look what there is now."""
        known = self._found
        try:
            self._found = self._store.get_if(TOKENS, None if known is None else known[1]) or known
        except AbsentError:
            self._found = None

    def load(self) -> tuple[Token, ...]:
        """Return the tokens of the last look."""
        return () if self._found is None else self._parse(self._found[0])

    def state(self) -> object:
        """Return the tag of the last look."""
        return None if self._found is None else self._found[1]

    @contextmanager
    def _change(self) -> Iterator[list[Token]]:
        self.look()
        tokens = list(self.load())
        yield tokens
        data = _document(tokens, write=secrets.token_hex(16))
        if self._found is None:
            self._found = data, self._store.create(TOKENS, data)
        else:
            self._found = data, self._store.replace(TOKENS, data, self._found[1])


def tokens_of(settings: Settings) -> TokenList:
    """Return where the tokens of a server are: in a file that the settings name, with the data otherwise.

    Raises
    ------
    StoreError
        If they are in a bucket that cannot be read.
    """
    if settings.token_file is not None:
        return TokenFile(settings.token_file)
    if isinstance(settings.data, Path):
        return TokenFile(settings.data / TOKENS)
    return TokenObject(open_store(settings.data))


class Tokens:
    """The tokens of a running server; follows changes of their list.

    Parameters
    ----------
    where : TokenList

    Raises
    ------
    LodestreamError, OSError
        If the list exists and cannot be used. If it becomes unusable later, no token is accepted.
    """

    def __init__(self, where: TokenList) -> None:
        self._list = where
        self._state = where.state()
        self._tokens = where.load()
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
        state = self._list.state()
        if state == self._state:
            return
        self._state = state
        try:
            self._tokens = self._list.load()
        except (LodestreamError, OSError) as error:
            self._tokens = ()
            self._met = True
            _log.error("no token is accepted until the token file is repaired: %s", error)
        self._met = self._met or bool(self._tokens)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()
