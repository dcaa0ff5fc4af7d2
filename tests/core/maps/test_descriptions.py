"""TileJSON and layer.json."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lodestream.errors import OptionError
from lodestream.maps import layer_json, tile_json
from lodestream.maps.tile_grids import box_of_mesh

from .fields import degrees, field_of, plane

ADDRESS = "https://example.org/v1/surfaces/1/tiles/{z}/{x}/{y}.png?v=2"


@pytest.mark.parametrize(("encoding", "said"), [("terrain-rgb", "mapbox"), ("terrarium", "terrarium"), ("shade", None)])
@pytest.mark.parametrize("size", [256, 512])
def test_tile_json(encoding: str, said: str | None, size: int) -> None:
    field = plane()
    told = tile_json(field, ADDRESS, encoding=encoding, size=size)  # type: ignore[arg-type]
    assert json.loads(json.dumps(told)) == told
    assert told["tiles"] == [ADDRESS]
    assert (told["tilejson"], told["scheme"], told["tileSize"], told["minzoom"]) == ("3.0.0", "xyz", size, 0)
    assert told.get("encoding") == said
    assert told["bounds"] == [*field.bounds]
    metres = 2 * np.pi * 6378137 * np.cos(np.radians(field.placement.latitude)) / size / 2.0 ** told["maxzoom"]
    assert metres <= field.placement.cell < 2 * metres
    with pytest.raises(OptionError, match="expected an encoding"):
        tile_json(field, ADDRESS, encoding="mapbox")  # type: ignore[arg-type]


def test_layer_json_lists_the_tiles_that_meet_the_field() -> None:
    field = plane()
    told = layer_json(field, "{z}/{x}/{y}.terrain")
    assert json.loads(json.dumps(told)) == told
    assert (told["format"], told["scheme"], told["projection"]) == ("quantized-mesh-1.0", "tms", "EPSG:4326")
    assert len(told["available"]) == told["maxzoom"] + 1
    assert told["available"][0] == [{"startX": 0, "startY": 0, "endX": 1, "endY": 0}]
    for z, boxes in enumerate(told["available"][1:], 1):
        (box,) = boxes
        for x in range(box["startX"] - 1, box["endX"] + 2):
            for y in range(box["startY"] - 1, box["endY"] + 2):
                listed = box["startX"] <= x <= box["endX"] and box["startY"] <= y <= box["endY"]
                assert field.placement.meets(box_of_mesh(z, x, y)) == listed


def test_across_the_dateline_there_are_two_boxes_and_the_bounds_go_around() -> None:
    field = field_of(np.zeros((21, 40)), degrees(170, 10, 0.5))
    west, _, east, _ = field.bounds
    assert (west, east) == pytest.approx((169.75, 189.75))
    assert tile_json(field, ADDRESS)["bounds"][::2] == [-180, 180]
    boxes = layer_json(field, "")["available"][3]
    assert [(box["startX"], box["endX"]) for box in boxes] == [(15, 15), (0, 0)]
    assert field.placement.meets(box_of_mesh(3, 15, 4))
    assert field.placement.meets(box_of_mesh(3, 0, 4))
    assert not field.placement.meets(box_of_mesh(3, 1, 4))
