"""Writes ``tables.h`` and ``class_tables.h``: constants of the coders (docs/format.md, section 7), and logarithms, for
encoders only.

``python core/kernels/tables.py`` makes them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, getcontext
from pathlib import Path

_HERE = Path(__file__).parent

_MOST_ADAPTED = 127
_MOST_IN_STRIPE = 512
_LOGARITHMS = 256

#: Of a large unit's contexts before its first pass: the probabilities of a 1 over 2**16, and the adaptation count.
_CLASS_STARTS = {
    "significance": """
        1769 6269 10941 17037 22777 15303 12725 16197 21319 25579 22090 19291 22284 26014 30911 24483 24690 26193
        28805 33543 37136 21576 21544 29250 40871
    """,
    "refinement": "17460",
    "signs": "29848 28496 30599 33607 30402 31139 33249 37776 33696 34465 34348 32465 35933 32560 31473",
    "flags": """
        873 5445 19444 9223 22512 37850 16482 23482 41024 9867 20496 43481 14984 37936 58064 18912 40816 56828 21977
        44089 58982 19476 54276 63525 15755 53595 63560
    """,
}
_STARTING_COUNT = 6


def rates() -> list[int]:
    """By what part a context with the adaptation count n moves, over 2**16: 2**16 / (n + 3/2), rounded down."""
    return [2**17 // (2 * count + 3) for count in range(_MOST_ADAPTED + 1)]


def class_starts() -> list[int]:
    """Probabilities of a large unit's contexts before its first pass, over 2**16, by number."""
    return [int(number) for numbers in _CLASS_STARTS.values() for number in numbers.split()]


def logarithms() -> list[int]:
    """2**32 log2(1 + i / 256), rounded, for i = 0 to 256."""
    getcontext().prec = 40
    two = Decimal(2).ln()
    entries = [2**32 * (1 + Decimal(i) / _LOGARITHMS).ln() / two for i in range(_LOGARITHMS + 1)]
    return [int(entry.to_integral_value()) for entry in entries]


def set_bits() -> list[list[int]]:
    """For each byte the numbers of the bits that are 1, rising, and zeros behind them."""
    numbers = ([bit for bit in range(8) if byte >> bit & 1] for byte in range(256))
    return [found + [0] * (8 - len(found)) for found in numbers]


def adaptation() -> list[int]:
    """By what part a large unit's context moves, over 2**16, by its adaptation count and what it has coded: 2**17 /
    (2 n + 1), rounded down; 0 for 0, where nothing moves.
    """
    return [0, *(2**17 // (2 * count + 1) for count in range(1, _MOST_ADAPTED + _MOST_IN_STRIPE + 1))]


def _lines(entries: Sequence[str]) -> str:
    lines, line = [], "   "
    for entry in entries:
        if len(line) + len(entry) + 2 > 120:
            lines.append(line)
            line = "   "
        line += f" {entry},"
    return "\n".join([*lines, line])


def _array(name: str, ctype: str, comment: str, values: list[int] | list[list[int]]) -> str:
    entries = [f"{{{', '.join(map(str, value))}}}" if isinstance(value, list) else str(value) for value in values]
    lengths = f"[{len(values)}]" + (f"[{len(values[0])}]" if isinstance(values[0], list) else "")
    return f"/* {comment} */\nstatic const {ctype} {name}{lengths} = {{\n{_lines(entries)}\n}};\n"


def _header(name: str, *parts: str) -> str:
    guard = f"LODE_{name.upper()}_H"
    return "\n".join(
        [
            "/* Made by tables.py, which says what each table is. */",
            "/* clang-format off */",
            f"#ifndef {guard}",
            f"#define {guard}\n",
            "#include <stdint.h>\n",
            *parts,
            "#endif",
            "/* clang-format on */\n",
        ]
    )


def headers() -> dict[Path, str]:
    """The headers and all that is in them."""
    texts = {
        "tables": [
            _array("RATES", "uint16_t", "By adaptation count, over 2^16.", rates()),
            _array("LOGARITHMS", "int64_t", "2^32 log2(1 + i / 256).", logarithms()),
        ],
        "class_tables": [
            f"enum {{ STARTING_COUNT = {_STARTING_COUNT} }};\n",
            _array("CLASS_STARTS", "uint16_t", "By context, over 2^16.", class_starts()),
            _array("SET_BITS", "uint8_t", "By byte: the numbers of its 1s.", set_bits()),
            _array("ADAPTATION", "uint16_t", "By the count of decisions, over 2^16.", adaptation()),
        ],
    }
    return {_HERE / f"{name}.h": _header(name, *parts) for name, parts in texts.items()}


if __name__ == "__main__":
    for path, text in headers().items():
        path.write_text(text)
