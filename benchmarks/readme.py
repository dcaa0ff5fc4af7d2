"""Prints the README's table of bytes against errors: ``python -m benchmarks.readme``."""

from __future__ import annotations

import sys
from pathlib import Path

import lodestream as ls
from lodestream_client.demo.terrain import terrain

from .arrays import ROOT

DATA = ROOT.parent / "shared" / "data"
ERRORS = (1e-2, 1e-3, 1e-4)
FILES = {
    "bigtujunga.tif": "bigtujunga, mountains, 643 x 1197, int16, whole metres",
    "etopo20.cdf": "etopo20, the whole Earth, 540 x 1080, float32",
    "lidar_dsm_2m.tif": "lidar surface model, 259 x 283, float32",
    "m6_small.fmt": "ONERA M6 wing, 9 blocks of x, y, z, float64",
}


def row(title: str, surface: ls.Surface) -> str:
    """Bytes of the points, of the stream to each error, and of the stream to the end."""
    decoder = ls.Decoder()
    views = decoder.feed(ls.encode(surface))
    assert decoder.header is not None, "the container is whole"
    extent = decoder.header.extent
    bytes_to = [next(view.bytes for view in views if view.rms <= error * extent) for error in ERRORS]
    counts = [sum(block.points.nbytes for block in surface.blocks), *bytes_to, views[-1].bytes]
    return f"| {title} | {' | '.join(f'{count:,}' for count in counts)} |"


def main(data: Path = DATA) -> int:
    """Print the table; exit code 1 where a file is not there."""
    missing = [name for name in FILES if not (data / name).exists()]
    if missing:
        print(f"expected {', '.join(missing)} in {data}", file=sys.stderr)
        return 1
    print(row("terrain of the demo, 1024 x 1280, int16, whole metres", ls.Surface(terrain((1024, 1280)))))
    for name, title in FILES.items():
        print(row(title, ls.read(data / name)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
