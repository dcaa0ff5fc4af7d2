"""A surface of many blocks that does not fit into the memory it may take: encoded, checked and decoded block by block.

It takes some minutes, so it runs only when it is named; ``LODESTREAM_BLOCKS_SIDE=256`` tries it on less.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

import lodestream

from .measure import gate, note, table
from .watched import command, row

#: Points along a side of a block, and blocks along a side of the surface.
SIDE, BLOCKS = int(os.environ.get("LODESTREAM_BLOCKS_SIDE", "1024")), 8
MEMORY, _MEMORY_BYTES = "512MiB", 512 << 20

_LODESTREAM = [sys.executable, "-m", "lodestream_client"]
_CHECK = """
import sys
from lodestream.decoding.inspection import inspect
inspect(open(sys.argv[1], "rb"), max_vertices=1 << 40, memory=int(sys.argv[2]))
"""


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, container, out = (folder / file for file in ("blocks.p3d", "blocks.lode", "again.p3d"))
        _write(source)
        runs = {
            f"`encode --memory {MEMORY}`": (
                command([*_LODESTREAM, "encode", str(source), str(container), "--memory", MEMORY]),
                container,
            ),
            "checked as a server does": (
                command([sys.executable, "-c", _CHECK, str(container), str(_MEMORY_BYTES)]),
                container,
            ),
            f"`decode --memory {MEMORY}` to PLOT3D": (
                command([*_LODESTREAM, "decode", str(container), str(out), "--memory", MEMORY]),
                out,
            ),
        }
        points = SIDE**2 * BLOCKS**2
        rows = [row(title, run, made, points) for title, (run, made) in runs.items()]
        size = source.stat().st_size / 1e9
        head = ["x, y, z, float32", "s", "µs a point", "bytes", "anonymous memory"]
        table(f"{BLOCKS * BLOCKS} blocks of {SIDE} x {SIDE}, {size:.1f} GB", head, rows)
        # PLOT3D has little-endian records with markers, as ours writes them: what came back is the file itself.
        same = source.read_bytes() == out.read_bytes() if source.stat().st_size < 1 << 31 else None
        note(f"The decoded file is the source, byte for byte: {same}.")
        gate(
            "22. memory of blocks, MiB", max(run.memory for run, _ in runs.values()) >> 20, at_most=_MEMORY_BYTES >> 20
        )


def _write(path: Path) -> None:
    """Waves over a warped plane, cut into blocks that share their sides; z in hundredths, as a solver may round it."""
    blocks = []
    for down in range(BLOCKS):
        for right in range(BLOCKS):
            y, x = np.mgrid[
                down * (SIDE - 1) : down * (SIDE - 1) + SIDE, right * (SIDE - 1) : right * (SIDE - 1) + SIDE
            ]
            z = 50 * np.sin(x / 170) * np.cos(y / 130) + np.sin(x * y / 9000) + 3 * np.sin(x / 11)
            points = np.stack([x + 0.1 * np.sin(y / 50), y, np.round(z, 2)], axis=-1)
            blocks.append(lodestream.Block(points.astype(np.float32)))
    lodestream.write(lodestream.Surface(blocks=blocks), path)
