"""Surfaces for the page, small enough for a browser that draws with the processor."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import lodestream as ls
from lodestream_client import Client
from tests.core.surfaces import terrain, torus

__all__ = ["GOLDEN", "Shelf", "surface"]

GOLDEN = Path(__file__).parents[1] / "golden"


@cache
def surface(name: str) -> ls.Surface:
    """One of the surfaces that are made here.

    ``terrain``: 200 x 250 heights in m, float32. ``holes``: the same without its middle. ``attribute``: with a
    temperature that is the number of the column. ``torus``: closed both ways, float32. ``wind``: with a vector of the
    numbers of row and column. ``line``: 1 x 250 heights. ``round``: 120 x 240 heights that go once round the Earth,
    from south to north and 0.75 E to 359.25 E, each as high as its longitude. ``halves``: 150 x 600 heights, the
    right half even.
    """
    heights = terrain((200, 250), 1).astype(np.float32)
    metadata = {"name": name, "unit": "m"}
    if name == "terrain":
        return ls.Surface(heights, metadata=metadata)
    if name == "holes":
        mask = np.ones(heights.shape, bool)
        mask[60:140, 75:175] = False
        return ls.Surface(heights, mask=mask, metadata=metadata)
    if name == "attribute":
        columns = np.broadcast_to(np.arange(250.0, dtype=np.float32), heights.shape)
        return ls.Surface(heights, attributes={"temperature": columns}, metadata=metadata)
    if name == "wind":
        wind = np.moveaxis(np.indices(heights.shape, np.float32), 0, 2)
        return ls.Surface(heights, attributes={"wind": np.ascontiguousarray(wind)}, metadata=metadata)
    if name == "line":
        return ls.Surface(heights[100:101], metadata=metadata)
    if name == "round":
        longitudes = np.arange(0.75, 360, 1.5).astype(np.float32)
        crs = 'GEOGCRS["WGS 84",ID["EPSG",4326]]'
        placed = {"geotransform": [0.0, 1.5, 0.0, -90.0, 0.0, 1.5], "crs": crs}
        return ls.Surface(np.tile(longitudes, (120, 1)), (False, True), metadata={**metadata, **placed})
    if name == "halves":
        rough = terrain((150, 600), 2).astype(np.float32)
        return ls.Surface(np.where(np.arange(600) < 256, rough, rough[:, 256:257]), metadata=metadata)
    assert name == "torus"
    return ls.Surface(torus(96, 64), (True, True), metadata={"name": name})


class Shelf:
    """Surfaces on a server, uploaded when they are first asked for."""

    def __init__(self, server: str) -> None:
        self.server = server
        self._uploaded: dict[str, Any] = {}

    def description(self, name: str) -> Any:
        """What the server says of a surface, see `surface`, or of a container of tests/golden."""
        if name not in self._uploaded:
            golden = GOLDEN / f"{name}.lode"
            self._uploaded[name] = Client(self.server).upload(golden if golden.exists() else surface(name))
        return self._uploaded[name]

    def decoded(self, name: str) -> ls.Surface:
        """All of a container of tests/golden."""
        return ls.decode((GOLDEN / f"{name}.lode").read_bytes())

    def address(self, name: str, view: str = "", server: str = "") -> str:
        """Where the page shows it; `view` follows in the address."""
        return f"{server or self.server}/#s={self.description(name).id}{'&' if view else ''}{view}"
