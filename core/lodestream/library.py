"""Loads the compiled kernels: the shared library that stands in ``native`` since the package was installed.

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
    """What the library of a platform is called; of this one, unless another is named."""
    suffix = {"darwin": "dylib", "win32": "dll"}.get(system, "so")
    return f"lodestream-{system}-{(machine or platform.machine()).lower()}.{suffix}"


def wide_name(system: str = sys.platform, machine: str | None = None) -> str | None:
    """What the second library is called, which is compiled for x86-64-v3; None where there is none.

    It holds the kernels that take 1.3 to 2 times as long without its wider registers: transforms, values.
    """
    name = (machine or platform.machine()).lower()
    return library_name(system, f"{name}-v3") if name in ("x86_64", "amd64") else None


def fingerprint() -> str | None:
    """A hash of all that the library is made from, 16 hexadecimal digits; None where there are no sources."""
    if not (KERNELS / "lodestream.h").exists():
        return None
    import hashlib  # programs that are installed do without

    digest = hashlib.sha256()
    for path in sorted([*KERNELS.glob("*.[ch]"), KERNELS / "build.py"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


class _Library(ctypes.CDLL):
    """A library, and where it has no function of a name, that of another one."""

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
    loaded = _load_from(NATIVE / library_name())
    wide = wide_name()
    if not isinstance(loaded, str) and wide and loaded.lode_runs_v3() and (NATIVE / wide).exists():
        wider = _load_from(NATIVE / wide)
        if not isinstance(wider, str) and wider.lode_sources() == loaded.lode_sources():
            wider.other = loaded
            return wider
    return loaded


def _load_from(path: Path) -> _Library | str:
    wanted = fingerprint()
    remedy = _COMPILE if wanted else _REMEDY
    if not path.exists():
        others = sorted(other.name for other in NATIVE.glob("lodestream-*"))
        found = f"found those of other platforms: {', '.join(others)}" if others else "found none"
        return f"expected the compiled kernels of this platform, {path.name}; {found}: {remedy}"
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
    """Whether the end of a library is missing, as after a copy onto a full disk: to load it would end the process."""
    with path.open("rb") as file:
        head = file.read(64)
        length = file.seek(0, 2)
    if head[:5] != b"\x7fELF\x02":  # of 64 bits
        return False
    table, size, count = (int.from_bytes(head[at:end], sys.byteorder) for at, end in ((40, 48), (58, 60), (60, 62)))
    return table + size * count > length  # the table of sections comes last


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
