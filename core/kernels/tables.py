"""Writes ``tables.h``: by how much contexts adapt (docs/format.md, "Contexts"), and logarithms, for encoders only.

``python core/kernels/tables.py`` makes it again.
"""

from __future__ import annotations

from decimal import Decimal, getcontext
from pathlib import Path

TABLES = Path(__file__).with_name("tables.h")

_MOST_ADAPTED = 127
_LOGARITHMS = 256


def rates() -> list[int]:
    """By what part a context with the adaptation count n moves, over 2**16: 2**16 / (n + 3/2), rounded down."""
    return [2**17 // (2 * count + 3) for count in range(_MOST_ADAPTED + 1)]


def logarithms() -> list[int]:
    """2**32 log2(1 + i / 256), rounded, for i = 0 to 256."""
    getcontext().prec = 40
    two = Decimal(2).ln()
    entries = [2**32 * (1 + Decimal(i) / _LOGARITHMS).ln() / two for i in range(_LOGARITHMS + 1)]
    return [int(entry.to_integral_value()) for entry in entries]


def _array(name: str, ctype: str, comment: str, values: list[int], suffix: str = "") -> str:
    lines, line = [], "   "
    for value in values:
        entry = f" {value}{suffix},"
        if len(line) + len(entry) > 120:
            lines.append(line)
            line = "   "
        line += entry
    return f"/* {comment} */\nstatic const {ctype} {name}[{len(values)}] = {{\n" + "\n".join([*lines, line]) + "\n};\n"


def text() -> str:
    """All of the header."""
    return "\n".join(
        [
            "/* Made by tables.py, which says what each table is. */",
            "/* clang-format off */",
            "#ifndef LODE_TABLES_H",
            "#define LODE_TABLES_H\n",
            "#include <stdint.h>\n",
            _array("RATES", "uint16_t", "By adaptation count, over 2^16.", rates()),
            _array("LOGARITHMS", "int64_t", "2^32 log2(1 + i / 256).", logarithms()),
            "#endif",
            "/* clang-format on */\n",
        ]
    )


if __name__ == "__main__":
    TABLES.write_text(text())
