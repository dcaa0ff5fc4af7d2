"""What ``lodestream.kernels`` declares, as C: a table of kernels, each with a function that calls it.

The compiler then holds the declarations, which `ctypes` believes, against the header: a pointer of another type, an
array that is written and declared as read, or an argument too many is an error.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from typing import Any

import numpy as np

from lodestream import kernels
from lodestream.kernels import INTEGER, Array, Kernel, Plane, Values

__all__ = ["declarations", "digest", "dispatch"]


def declarations() -> dict[str, tuple[Any, ...]]:
    """The arguments of every kernel, by its name, in the order of ``kernels.py``."""
    return {kernel.name: kernel.arguments for kernel in vars(kernels).values() if isinstance(kernel, Kernel)}


def _ctype(dtype: np.dtype[Any]) -> str:
    if dtype.kind == "f":
        return {4: "float", 8: "double"}[dtype.itemsize]
    return f"{'u' if dtype.kind in 'ub' else ''}int{8 * dtype.itemsize}_t"


def _declared(argument: Any) -> str:
    if isinstance(argument, Values):
        return f"{{VALUES, 0, false, {str(argument.written).lower()}}}"
    if not isinstance(argument, Array | Plane):
        return "{INTEGER, 8, false, false}" if argument is INTEGER else "{REAL, 8, true, false}"
    kind = "ARRAY" if isinstance(argument, Array) else "PLANE"
    words = [str(argument.dtype.kind == "f").lower(), str(argument.written).lower()]
    return f"{{{kind}, {argument.dtype.itemsize}, {', '.join(words)}}}"


def _passed(place: int, argument: Any) -> str:
    if isinstance(argument, Values):
        return f"({'' if argument.written else 'const '}void *)v[{place}].at, v[{place}].count, v[{place}].integer"
    if not isinstance(argument, Array | Plane):
        return f"v[{place}].{'integer' if argument is INTEGER else 'real'}"
    pointer = f"({'' if argument.written else 'const '}{_ctype(argument.dtype)} *)v[{place}].at"
    if isinstance(argument, Array):
        return f"{pointer}, v[{place}].count"
    return f"{pointer}, v[{place}].rows, v[{place}].columns, v[{place}].pitch"


def dispatch(names: Collection[str] | None = None) -> str:
    """The table as a C file, beside ``calls.h``, of all kernels or some."""
    lines = ['#include "calls.h"', '#include "lodestream.h"', ""]
    table = {name: arguments for name, arguments in declarations().items() if names is None or name in names}
    for name, arguments in table.items():
        values = [_passed(place, argument) for place, argument in enumerate(arguments)]
        plain = Kernel(name, *arguments).plain
        if plain < len(values):
            values[plain:] = [f"&(struct lode_{name}){{{', '.join(values[plain:])}}}"]
        passed = ", ".join(values)
        lines += [
            f"static int64_t call_{name}(const struct value *v) {{ return lode_{name}({passed}); }}",
            f"static const struct declared {name}[] = {{{', '.join(map(_declared, arguments))}}};",
        ]
    entries = [f'{{"{name}", {len(arguments)}, {name}, call_{name}}},' for name, arguments in table.items()]
    lines += ["const struct kernel KERNELS[] = {", *entries, "};", f"const int64_t KERNEL_COUNT = {len(table)};"]
    digest = int.from_bytes(hashlib.sha256("\n".join(lines).encode()).digest()[:8], "little")
    return "\n".join([*lines, f"const uint64_t DECLARED = UINT64_C({digest});", ""])


def digest(names: Collection[str] | None = None) -> int:
    """The number by which files of calls are known to be of these declarations."""
    return int(dispatch(names).rpartition("UINT64_C(")[2].partition(")")[0])
