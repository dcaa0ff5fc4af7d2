"""Tiles of maps and globes, and the documents that clients open first; made in a process that is kept.

The process holds the containers that were asked for most recently by their descriptors, with their indexes, and
decoded blocks. It reads files of strangers, so what it answers is not trusted (`tile_maker`).
"""

from __future__ import annotations

import gzip
import json
import os
from base64 import b64encode
from collections import OrderedDict
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from lodestream.errors import LodestreamError
from lodestream.target import Tolerance

from .answers import Refusal

if TYPE_CHECKING:
    from collections.abc import Callable

    from lodestream.maps import HeightField
    from lodestream.maps.web_tiles import Encoding, ImageFormat

__all__ = ["REVISION", "MadeTile", "TileOrder", "answer", "service"]

#: Raise this with every change by which a tile of the same container becomes one of other bytes.
REVISION = 1

# Containers that are open at the same time.
_OPEN = 16

# Of a mesh, gzip at its usual level takes a fifth of the bytes; more takes long and saves little.
_GZIP_LEVEL = 6


class TileOrder(NamedTuple):
    """What is to be made of a container.

    Attributes
    ----------
    what : "map", "tile", "layers" or "mesh"
        A TileJSON, an image, a layer.json or a quantized mesh.
    z, x, y : int
        Of a tile.
    address : str
        Of tiles, in a document.
    name : str
        Of the surface, in a document.
    encoding, image, size, nodata
        Of an image, see `lodestream.maps.web_tile`.
    scale : float or None
        Of the heights, see `lodestream.maps.HeightField`.
    error : str
        How far heights may be off, as `Tolerance` writes it.
    offset : float
        Added to the heights of a mesh, in metres.
    normals : bool
        Whether a mesh has the extension octvertexnormals.
    is_gzipped : bool
    """

    what: Literal["map", "tile", "layers", "mesh"]
    z: int = 0
    x: int = 0
    y: int = 0
    address: str = ""
    name: str = ""
    encoding: str = "terrain-rgb"
    image: str = "png"
    size: int = 256
    nodata: float = 0.0
    scale: float | None = None
    error: str = str(Tolerance(0))
    offset: float = 0.0
    normals: bool = False
    is_gzipped: bool = False

    def __str__(self) -> str:
        """Return what it is, for the log: strangers choose the rest."""
        return f"{self.what} {self.z}/{self.x}/{self.y}"


@dataclass(frozen=True)
class MadeTile:
    """The bytes of a tile or a document, in base64; none where the surface does not reach the tile."""

    data: str


def service(cache_bytes: int, max_vertices: int) -> Callable[[str, list[Any], int], MadeTile | Refusal]:
    """Return what answers in a process that is kept: `answer` with containers and blocks of its own.

    Parameters
    ----------
    cache_bytes : int
        Of decoded blocks.
    max_vertices : int
        Limit on the memory of a container's index.
    """
    return partial(answer, _Fields(cache_bytes, max_vertices))


def answer(fields: _Fields, container: str, order: list[Any], descriptor: int) -> MadeTile | Refusal:
    """Make what is ordered.

    Parameters
    ----------
    fields : object
        The containers that are open.
    container : str
        Its SHA-256, by which it is known.
    order : list
        The values of a `TileOrder`.
    descriptor : int
        Of the container's file; it is duplicated if it is to stay open.
    """
    # Errors come back as values: not every exception survives the way between processes.
    try:
        wanted = TileOrder(*order)
        field = fields.get(container, descriptor, scale=wanted.scale, error=wanted.error)
        data = _made(field, wanted)
    except LodestreamError as error:
        return Refusal.of(error)
    if data and wanted.is_gzipped:
        data = gzip.compress(data, _GZIP_LEVEL, mtime=0)
    return MadeTile(b64encode(data).decode())


class _Fields:
    """The containers that were asked for most recently."""

    def __init__(self, cache_bytes: int, max_vertices: int) -> None:
        from lodestream.maps import BlockCache

        self._cache = BlockCache(cache_bytes)
        self._max_vertices = max_vertices
        self._open: OrderedDict[str, tuple[HeightField, int]] = OrderedDict()

    def get(self, container: str, descriptor: int, *, scale: float | None, error: str) -> HeightField:
        """Return a container as heights; it stays open for later requests, whatever their options."""
        from lodestream.maps import HeightField

        self._let_go()
        if container in self._open:
            self._open.move_to_end(container)
            return self._open[container][0].with_options(scale=scale, error=error)
        file = os.dup(descriptor)
        try:
            field = HeightField(
                lambda offset, length: os.pread(file, length, offset),
                os.fstat(file).st_size,
                scale=scale,
                error=error,
                cache=self._cache,
                max_vertices=self._max_vertices,
            )
        except BaseException:
            os.close(file)
            raise
        self._open[container] = field, file
        while len(self._open) > _OPEN:
            os.close(self._open.popitem(last=False)[1][1])
        return field

    def _let_go(self) -> None:
        """Close the files that were removed, which take room on the disk until then."""
        for container, (_, file) in list(self._open.items()):
            if not os.fstat(file).st_nlink:
                os.close(file)
                del self._open[container]


def _made(field: HeightField, order: TileOrder) -> bytes:
    from lodestream.maps import layer_json, mesh_tile, tile_json, web_tile
    from lodestream.maps.tile_grids import box_of_mesh, box_of_web

    encoding: Encoding = order.encoding  # type: ignore[assignment]  # which is looked at there
    image: ImageFormat = order.image  # type: ignore[assignment]
    place = order.z, order.x, order.y
    match order.what:
        case "map":
            return _document(tile_json(field, order.address, encoding=encoding, size=order.size), order.name)
        case "layers":
            return _document(layer_json(field, order.address), order.name)
        case "tile":
            made = web_tile(field, *place, encoding=encoding, image=image, size=order.size, nodata=order.nodata)
            box = box_of_web(*place)
        case "mesh":
            made = mesh_tile(field, *place, nodata=order.nodata, offset=order.offset, normals=order.normals)
            # A globe shows nothing before it has both tiles of zoom 0.
            box = box_of_mesh(*place) if order.z else field.bounds
    return made if field.placement.meets(box) else b""


def _document(content: dict[str, Any], name: str) -> bytes:
    return json.dumps({**content, "name": name}, ensure_ascii=False).encode()
