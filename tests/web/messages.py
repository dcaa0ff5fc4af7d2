"""Messages, most of them damaged, and what the library takes them for; ``python -m tests.web.messages SEED COUNT``.

Prints a line of JSON for each: its bytes, and the type of the event or the code of the error. The tests of `client/web`
take the same messages for the same.
"""

from __future__ import annotations

import json
import sys
from random import Random
from typing import Any

import msgpack

from lodestream.errors import UnsupportedVersionError
from lodestream.protocol.messages import (
    Bye,
    Credit,
    End,
    Error,
    Event,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
    Stop,
)
from lodestream.protocol.wire import parse, serialize
from lodestream.target import Target, Tolerance

_DIGEST = "0123456789abcdef" * 4
_EVENTS: list[Event] = [
    Open(Target(level=3), 1000, ((0, 96), (200, 1)), _DIGEST, "lode_dG9rZW4"),
    Open(Target(until_rms=Tolerance(1e-3, True), max_bytes=20000, region=((0, 4), (2, 9)), attributes=("a",)), 0),
    Open(Target(level=3, region=((0, 4), (2, 9))), 0, window_errors=True, decodes=True),
    Open(Target(until_rms={"speed": 0.5}, until_max={"speed": 2.0, "z": 1.0}), 0),
    Credit(5),
    Stop(),
    Bye(),
    Opened(_DIGEST, 2**40, 12345, 1.5, (2**39, 500), (13000, 1), True, channels=True),
    Segments(7, bytes(range(40))),
    Layer(0, 2, 96, 0.125, 3.5),
    End("complete"),
    Error("not-found", "No such surface", "expected one of ..., got é"),
]
_VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 2**31, 2**53, 2**53 + 1, 2**63, 0.5, float("nan"), float("inf"), "", "quality",
    "level", "x" * 300, _DIGEST, b"", b"a", [], [1], [1, 2], [0, 0], [[1, 2], [3, 4]], [[1, 2]], [0.5, True],
    [-1.0, False], {}, {"level": 1}, {"level": 1, "max_bytes": 5}, {"order": "other"}, {"until_max": [1, False]},
    [["a", "rms", 1]], [["a", "min", 1]], {"channels": [["a", "max", 1], ["a", "max", 2]]},
    {"channels": [["a", "rms"]]},
    {"channels": [["a", "rms", 1]], "until_max": [1, False]}, {"channels": [["a", "rms", 1], ["a", "max", 2]]},
]  # fmt: skip


def message(random: Random) -> bytes:
    """A message of which some field, key or byte is another."""
    whole = serialize(random.choice(_EVENTS))
    kind = random.choice(["whole", "field", "field", "field", "target", "missing", "key", "cut", "more", "byte"])
    if kind == "cut":
        return whole[: random.randrange(len(whole))]
    if kind == "more":
        return whole + random.randbytes(1)
    if kind == "byte":
        place = random.randrange(len(whole))
        return whole[:place] + random.randbytes(1) + whole[place + 1 :]
    fields = msgpack.unpackb(whole)
    name = random.choice(list(fields))
    if kind == "field":
        fields[name] = random.choice(_VALUES)
    elif kind == "target" and "target" in fields:
        key = random.choice(["level", "until_rms", "until_max", "max_bytes", "order", "region", "attributes", "first"])
        fields["target"][key] = random.choice(_VALUES)
    elif kind == "missing":
        del fields[name]
    elif kind == "key":
        fields[random.choice(["later", "x", "Type"])] = random.choice(_VALUES)
    packed: bytes = msgpack.packb(fields)
    return packed


def verdict(data: bytes) -> str:
    """What the library takes a message for."""
    try:
        return parse(data).type
    except MessageError as error:
        return error.code
    except UnsupportedVersionError:
        return "unsupported-version"


def main(seed: int, count: int) -> None:
    """Print so many messages."""
    random = Random(seed)
    for _ in range(count):
        made = message(random)
        print(json.dumps([made.hex(), verdict(made)]))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
