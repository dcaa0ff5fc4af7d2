"""Damaged containers and what is said of them, as JSON; ``python -m tests.web.damaged SEED COUNT`` prints one a line.

First every golden file with a bit changed here and there, then COUNT containers with other contents in a field, and
small ones with each other dtype, all checksums that enclose it made right. The decoder of `client/web` must say the
same, at the same place.
"""

from __future__ import annotations

import base64
import json
import random
import sys
from collections.abc import Iterator
from typing import Any

import lodestream as ls
from lodestream.errors import LodestreamError
from tests.core.container.forgery import with_dtypes
from tests.core.container.mutants import mutant
from tests.core.container.test_hostile_containers import MOST, containers
from tests.golden.generate import FOLDER, digests


def main(seed: int, count: int) -> None:
    """Flipped bits, then mutants, then other dtypes."""
    for name, data in (*flipped(seed), *mutants(seed, count), *retyped()):
        print(json.dumps({"name": name, "container": base64.b64encode(data).decode(), **said(data)}), flush=True)


def flipped(seed: int) -> Iterator[tuple[str, bytes]]:
    """Golden files with a bit changed: in the first bytes, in the last ones, and anywhere; or cut off."""
    for path in sorted(FOLDER.glob("*.lode")):
        data, chance = path.read_bytes(), random.Random(f"{seed} {path.name}")
        places = [chance.randrange(8), chance.randrange(8, 40), len(data) - 1 - chance.randrange(60)]
        for place in (*places, *(chance.randrange(len(data)) for _ in range(3))):
            changed = bytearray(data)
            changed[place] ^= 1 << chance.randrange(8)
            yield f"{path.stem}, byte {place}", bytes(changed)
        yield f"{path.stem}, cut", data[: chance.randrange(len(data))]


def mutants(seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Of small containers with everything that one may have."""
    chance, known = random.Random(seed), sorted(containers())
    for number in range(count):
        name = known[number % len(known)]
        yield f"{name}, mutant {number}", mutant(*containers()[name], chance)


def retyped() -> Iterator[tuple[str, bytes]]:
    """Of the same containers."""
    for name, (data, _) in sorted(containers().items()):
        for what, dtype, changed in with_dtypes(data):
            yield f"{name}, {what or 'points'} as {dtype}", changed


def said(data: bytes) -> dict[str, Any]:
    """The error of a decoder, the views before it, and the values of the last one, or its error."""
    decoder = ls.Decoder(max_vertices=MOST)
    found: dict[str, Any] = {"error": None, "surface": None}
    try:
        decoder.feed(data)
        decoder.finish()
        decoder.index  # noqa: B018 - which is parsed when it is asked for; browsers parse it at once
    except LodestreamError as error:
        found["error"] = _plain(error)
    found["views"] = [[view.number, view.level, view.bytes, view.rms, view.max_error] for view in decoder.layers]
    if decoder.layers:
        try:
            found["surface"] = digests(decoder.surface())
        except LodestreamError as error:
            found["surface"] = _plain(error)
    return found


def _plain(error: LodestreamError) -> dict[str, Any]:
    return {"class": type(error).__name__, "offset": getattr(error, "offset", None), "message": str(error)}


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
