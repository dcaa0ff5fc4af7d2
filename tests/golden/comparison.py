"""What a decoder written like `tests.reference` makes of a golden file, beside what `expected.json` says of it."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from numpy.typing import NDArray

__all__ = ["EXPECTED", "compared", "digests", "file_of", "values_of"]

_FOLDER = Path(__file__).parent
EXPECTED: dict[str, dict[str, Any]] = json.loads((_FOLDER / "expected.json").read_text())


@functools.cache
def file_of(name: str) -> bytes:
    """The bytes of a golden file."""
    return (_FOLDER / f"{name}.lode").read_bytes()


def values_of(name: str) -> int:
    """How many values a golden file has: points times channels."""
    arrays = [array for block in EXPECTED[name]["blocks"] for array in (block["points"], *block["attributes"].values())]
    return sum(math.prod(array["shape"]) for array in arrays)


def compared(decoder: ModuleType, name: str, states: float = math.inf) -> Iterator[tuple[str, Any, Any]]:
    """Decode a golden file.

    Parameters
    ----------
    decoder : module
        `tests.reference`, or a copy of it.
    name : str
    states : float
        About how many layers are shown, of those that there are; always the first and the last.

    Yields
    ------
    what, found, expected
        What is compared, what the decoder has, and what it must have.

    Raises
    ------
    Exception
        Whatever the decoder raises.
    """
    data, expected = file_of(name), EXPECTED[name]
    container = decoder.read_container(data)
    decoded = decoder.decode(container)
    yield from _header(container, decoded.shown(residual=container.residual), expected)
    residual, layers = container.residual, expected["layers"]
    yield "layers", len(container.layers), len(layers) - (residual is not None)
    for number, (layer, wanted) in enumerate(zip(container.layers, layers, strict=False)):
        figures = layer.end, layer.errors.rms, layer.errors.maximum
        yield f"figures of layer {number}", figures, (wanted["bytes"], wanted["rms"], wanted["max"])
    *coarser, finest = expected["levels"]
    yield "levels", container.header.finest, len(coarser)
    for level, wanted in enumerate(coarser):
        yield f"level {level}", digests(decoded.shown(level=level)), wanted
    yield f"level {len(coarser)}", digests(decoded.shown(residual=residual)), finest
    for number in _spread(len(container.layers), states):
        yield f"layer {number}", digests(decoded.shown(number + 1)), layers[number]["sha256"]
        for level, wanted in enumerate(expected["partial"][number] if "partial" in expected else ()):
            yield f"level {level} of layer {number}", digests(decoded.shown(number + 1, level=level)), wanted
    if residual is not None:
        yield "errors that the residual leaves", residual.errors[:2], (layers[-1]["rms"], layers[-1]["max"])
    if "channels" in expected:
        told = [layer.errors.channels for layer in container.layers]
        told += [] if residual is None else [residual.errors.channels]
        yield "errors of channels", [[list(errors) for errors in state] for state in told], expected["channels"]
    yield from _index(decoder.read_index(data, container), data, container)


def _header(container: Any, shown: list[Any], expected: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    header = container.header
    names = [attribute.name for attribute in header.attributes]
    blocks = [
        {
            "closed": list(block.closed),
            "holes": int((~own.valid).sum()),
            "points": _kind(own.arrays[0]),
            "attributes": dict(zip(names, map(_kind, own.arrays[1:]), strict=True)),
        }
        for block, own in zip(header.blocks, shown, strict=True)
    ]
    yield "blocks", blocks, expected["blocks"]
    yield "a residual", container.residual is not None, header.has_residual
    yield "masks", any((~mask).any() for mask in container.masks.valid), header.has_masks
    yield "metadata", container.metadata is not None, True
    values = hashlib.sha256(b"".join(array.tobytes() for block in shown for array in block.arrays)).hexdigest()
    yield "the digest of the values", container.metadata.get("values_sha256"), values if header.exact else None


def _index(index: Any, data: bytes, container: Any) -> Iterator[tuple[str, Any, Any]]:
    """Hold the index to the sections that it tells of."""
    yield "errors of the layers", index.layer_errors, [layer.errors for layer in container.layers]
    yield "errors of the finest level", index.level_errors[-1], (container.residual or container.layers[-1]).errors
    told = [[entry.take(data) for entry in entries] for entries in index.segments]
    named = [[(s.unit, s.passes, s.data) for s in layer.segments] for layer in container.layers]
    yield "segments", [[(s.unit, s.passes, s.data) for s in layer] for layer in told], named
    tops = {s.unit: s.top for layer in container.layers for s in layer.segments if s.top is not None}
    yield "bit-planes", {s.unit: s.top for layer in told for s in layer}, tops
    chunks = [] if container.residual is None else container.residual.chunks
    yield "chunks", [chunk.take(data).data for chunk in index.chunks], chunks
    before = [kind for kind, offset, _ in index.optional if offset < len(data)][: len(container.optional)]
    yield "optional sections", before, [kind for kind, _ in container.optional]


def _spread(layers: int, most: float) -> list[int]:
    """Numbers of so many layers, evenly from the first to the last."""
    count = int(min(layers, max(2, most)))
    return sorted({round(k * (layers - 1) / max(1, count - 1)) for k in range(count)})


def digests(blocks: list[Any]) -> list[str]:
    """Of each block that a decoder shows, the digest of its points and then its attributes."""
    return [hashlib.sha256(b"".join(array.tobytes() for array in block.arrays)).hexdigest()[:20] for block in blocks]


def _kind(array: NDArray[Any]) -> dict[str, Any]:
    return {"type": array.dtype.name, "shape": list(array.shape)}
