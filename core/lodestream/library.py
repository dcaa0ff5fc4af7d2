"""Loads the compiled kernels: the shared library that stands in ``native`` since the package was installed."""

from __future__ import annotations

import ctypes
import hashlib
import platform
import sys
from functools import cache
from pathlib import Path

from .errors import UnavailableError

__all__ = ["library", "library_name", "require", "why_missing"]

_NATIVE = Path(__file__).with_name("native")
_REMEDY = "install the package again where there is a C compiler, or from a wheel of this platform"


def library_name(system: str = sys.platform, machine: str = platform.machine()) -> str:
    """What the library of a platform is called."""
    suffix = {"darwin": "dylib", "win32": "dll"}.get(system, "so")
    return f"lodestream-{system}-{machine.lower()}.{suffix}"


@cache
def _load() -> ctypes.CDLL | str:
    path = _NATIVE / library_name()
    if not path.exists():
        others = sorted(other.name for other in _NATIVE.glob("lodestream-*"))
        found = f"found those of other platforms: {', '.join(others)}" if others else "found none"
        return f"expected the compiled kernels of this platform, {path.name}; {found}: {_REMEDY}"
    try:
        loaded = ctypes.CDLL(str(path))
        loaded.lode_sources.restype = ctypes.c_char_p
        made_from = loaded.lode_sources().decode()
    except (OSError, AttributeError) as error:
        return f"expected compiled kernels in {path}, which cannot be loaded ({error}): {_REMEDY}"
    wanted = _fingerprint()
    if wanted is not None and made_from != wanted:
        return f"expected kernels compiled from the sources beside them ({wanted}), got {made_from}: run make"
    return loaded


def _fingerprint() -> str | None:
    """The hash of the sources in a working tree, see ``kernels/build.py``; None where there are none."""
    folder = Path(__file__).parents[1] / "kernels"
    if not (folder / "build.py").exists():
        return None
    digest = hashlib.sha256()
    for path in sorted([*folder.glob("*.[ch]"), folder / "build.py"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def why_missing() -> str | None:
    """Why the compiled kernels cannot be used here, in a line; None where they can."""
    loaded = _load()
    return loaded if isinstance(loaded, str) else None


def require(what: str) -> None:
    """Refuse, before any of it is done, what cannot be done without the kernels: ``"encoding"``.

    Raises
    ------
    UnavailableError
        Where they are missing.
    """
    if (why := why_missing()) is not None:
        raise UnavailableError(f"{what} is not possible here: {why}")


def library() -> ctypes.CDLL:
    """The library.

    Raises
    ------
    UnavailableError
        Where it cannot be loaded.
    """
    loaded = _load()
    if isinstance(loaded, str):
        raise UnavailableError(loaded)
    return loaded
