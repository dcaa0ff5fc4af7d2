"""Writes ``tables.h``: the constants of the binary coder, and logarithms.

``python core/kernels/tables.py`` makes it again. docs/format.md, "The range coder", defines the tables; that of
logarithms serves encoders only.
"""

from __future__ import annotations

import bisect
from decimal import Decimal, getcontext
from pathlib import Path

TABLES = Path(__file__).with_name("tables.h")

#: 2**16 / (1 + exp(-i / 4)), rounded, for i = 0 to 32.
# fmt: off
LOGISTIC = [
    32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565,
    61598, 62428, 63090, 63615, 64030, 64357, 64614, 64816, 64974, 65097, 65194,
    65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508, 65514,
]
# fmt: on
_MOST_ADAPTED = 127
_LOGARITHMS = 256


def rates() -> list[int]:
    """By what part a context with the adaptation count n moves, over 2**16: 2**16 / (n + 3/2), rounded down."""
    return [2**17 // (2 * count + 3) for count in range(_MOST_ADAPTED + 1)]


def squash() -> list[int]:
    """Probability over 2**16 of x in 1/256, entry x + 2048: between anchors in a straight line, rounded down."""
    anchors = [65536 - value for value in LOGISTIC[:0:-1]] + LOGISTIC
    table = []
    for x in range(4096):
        whole, part = divmod(x, 64)
        table.append(min(max((anchors[whole] * (64 - part) + anchors[whole + 1] * part) >> 6, 32), 65504))
    return table


def stretch() -> list[int]:
    """The inverse: for the highest 12 bits p of a probability the least x with squash >= 16 p + 8, within +-2047."""
    chances = squash()
    return [min(max(bisect.bisect_left(chances, 16 * p + 8) - 2048, -2047), 2047) for p in range(4096)]


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
            _array("SQUASH", "uint16_t", "Probability over 2^16, by x + 2048.", squash()),
            _array("STRETCH", "int16_t", "x, by the highest 12 bits of a probability.", stretch()),
            _array("LOGARITHMS", "int64_t", "2^32 log2(1 + i / 256).", logarithms()),
            "#endif",
            "/* clang-format on */\n",
        ]
    )


if __name__ == "__main__":
    TABLES.write_text(text())
