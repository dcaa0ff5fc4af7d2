"""Tiles of height fields for maps and globes: terrain-RGB, terrarium, shaded relief, quantized meshes.

Needs the extra ``maps``. `field` says where the heights of a container lie and computes them anywhere; `web_tiles` and
`meshes` make tiles of them, `descriptions` the documents that clients open first. Nothing here knows a server.
"""

from .block_cache import BlockCache
from .descriptions import layer_json, tile_json
from .field import HeightField
from .meshes import mesh_tile
from .projection import crs_wkt
from .web_tiles import png, shaded, terrain_rgb, terrarium, web_tile, webp

__all__ = [
    "BlockCache",
    "HeightField",
    "crs_wkt",
    "layer_json",
    "mesh_tile",
    "png",
    "shaded",
    "terrain_rgb",
    "terrarium",
    "tile_json",
    "web_tile",
    "webp",
]
