"""Loading of the compiled kernels: the shared library in ``native``, compiled when the package is installed.

``core/kernels/build.py`` imports this module before anything is installed: it needs the standard library alone.
"""

from __future__ import annotations

import ctypes
import platform
import sys
from functools import cache
from pathlib import Path
from typing import Any

from .errors import UnavailableError

__all__ = [
    "KERNELS",
    "NATIVE",
    "fingerprint",
    "is_cut_off",
    "library",
    "library_name",
    "require",
    "why_missing",
    "wide_name",
]

#: Where the library stands, and where its sources stand in a working tree.
NATIVE = Path(__file__).with_name("native")
KERNELS = Path(__file__).parents[1] / "kernels"
_REMEDY = "install the package again where there is a C compiler, or from a wheel of this platform"
_COMPILE = "run `make kernels` in the working tree, or `python core/kernels/build.py`"


def library_name(system: str = sys.platform, machine: str | None = None) -> str:
    """Return the file name of the library of a platform, by default of this one."""
    suffix = {"darwin": "dylib", "win32": "dll"}.get(system, "so")
    return f"lodestream-{system}-{(machine or platform.machine()).lower()}.{suffix}"


def wide_name(system: str = sys.platform, machine: str | None = None) -> str | None:
    """Return the file name of the second library, for x86-64-v3; None where there is none.

    It contains the kernels that are 1.3 to 2 times as fast with wider registers: transforms, values.
    """
    name = (machine or platform.machine()).lower()
    return library_name(system, f"{name}-v3") if name in ("x86_64", "amd64") else None


def fingerprint() -> str | None:
    """Return a hash of the library's sources, 16 hexadecimal digits; None where there are no sources."""
    if not (KERNELS / "lodestream.h").exists():
        return None
    import hashlib  # not needed by an installed package

    digest = hashlib.sha256()
    for path in sorted([*KERNELS.glob("*.[ch]"), KERNELS / "build.py"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


class _Library(ctypes.CDLL):
    """A library that takes functions it does not have from another one."""

    other: ctypes.CDLL | None = None

    def __getitem__(self, name_or_ordinal: Any) -> Any:
        try:
            return super().__getitem__(name_or_ordinal)
        except AttributeError:
            if self.other is None:
                raise
            return self.other[name_or_ordinal]


@cache
def _load() -> ctypes.CDLL | str:
    """Load the library for this machine; return the reason if it cannot be loaded."""
    loaded = _load_from(NATIVE / library_name())
    wide = wide_name()
    if not isinstance(loaded, str) and wide and loaded.lode_runs_v3() and (NATIVE / wide).exists():
        wider = _load_from(NATIVE / wide)
        if not isinstance(wider, str) and wider.lode_sources() == loaded.lode_sources():
            wider.other = loaded
            return wider
    return loaded


def _load_from(path: Path) -> _Library | str:
    """Load a library; return the reason if it cannot be loaded."""
    wanted = fingerprint()
    remedy = _COMPILE if wanted else _REMEDY
    if not path.exists():
        others = sorted(other.name for other in NATIVE.glob("lodestream-*"))
        other_libraries = f"found those of other platforms: {', '.join(others)}" if others else "found none"
        return f"expected the compiled kernels of this platform, {path.name}; {other_libraries}: {remedy}"
    try:
        if is_cut_off(path):
            raise OSError("its end is missing")
        loaded = _Library(str(path))
        loaded.lode_sources.restype = ctypes.c_char_p
        made_from = loaded.lode_sources().decode()
    except (OSError, AttributeError) as error:
        return f"expected compiled kernels in {path}, which cannot be loaded ({error}): {remedy}"
    if wanted and made_from != wanted:
        return f"expected kernels compiled from the sources beside them ({wanted}), got {made_from}: {remedy}"
    return loaded


def is_cut_off(path: Path) -> bool:
    """Return whether a library is truncated, as after a copy onto a full disk: loading it would crash the process."""
    with path.open("rb") as file:
        head = file.read(64)
        length = file.seek(0, 2)
    if head[:5] != b"\x7fELF\x02":  # of 64 bits
        return False
    table, size, count = (int.from_bytes(head[at:end], sys.byteorder) for at, end in ((40, 48), (58, 60), (60, 62)))
    return table + size * count > length  # the table of sections comes last


def why_missing() -> str | None:
    """Return the reason why the compiled kernels cannot be used here, in a line; None if they can."""
    loaded = _load()
    return loaded if isinstance(loaded, str) else None


def require(what: str) -> None:
    """Raise an error if the kernels, which ``what`` needs, are missing.

    Raises
    ------
    UnavailableError
        Where they are missing.
    """
    if (why := why_missing()) is not None:
        raise UnavailableError(f"{what} is not possible here: {why}")


def library() -> ctypes.CDLL:
    """Return the loaded library.

    Raises
    ------
    UnavailableError
        If it cannot be loaded.
    """
    loaded = _load()
    if isinstance(loaded, str):
        raise UnavailableError(loaded)
    return loaded
