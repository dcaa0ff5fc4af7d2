"""The mark of a Dataset or a file that Lodestream has made: what has no other place there, and makes it whole again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...container.metadata import packed
from ...errors import InputError
from ...surface import Closed, Surface
from ..notes import warn
from .attribute_texts import TYPES, text_of
from .choice import Choice, is_numeric
from .crs import beside_crs
from .layout import CONVENTIONS, MAPPING, ORDERED, Grid, Part, axis_attributes, said_of, scale_of
from .single_numbers import SCALARS

__all__ = ["MARK", "NUMBERS", "Mark", "in_json", "mark_text"]

#: The attribute of a Dataset that holds the mark, as JSON.
MARK = "lodestream"

#: Coordinates that number rows and columns.
NUMBERS = ("row", "column")

#: Metadata that coordinates say, or that stand in attributes of the CF conventions.
_TOLD = ("geotransform", "grid", "axes", "nodes", "crs", "unit", "tags", "angles", "dtype")

#: Metadata that are true of a grid of the same shape only.
_OF_THE_SHAPE = ("seam", "dtype", "angles", *ORDERED)

#: Of stored numbers of a raster.
_SCALE = ("scale", "offset")

#: The owner of the attributes of a file.
_FILE = "NC_GLOBAL"


def mark_text(grid: Grid, parts: Sequence[Part], title: str) -> str:
    """Make the mark of a block.

    Parameters
    ----------
    grid : Grid
    parts : sequence of Part
    title : str
        How a note about what JSON cannot hold begins, such as "NetCDF is written".
    """
    metadata, lost = in_json({key: value for key, value in grid.metadata.items() if key not in _TOLD})
    if lost:
        warn(f"{title} without {', '.join(lost)}, which JSON cannot hold")
    scalars, single = grid.metadata.get(SCALARS), {part.name for part in parts if part.is_number}
    rest = {key: it for key, it in scalars.items() if key not in single} if isinstance(scalars, Mapping) else {}
    metadata = {key: value for key, value in metadata.items() if key != SCALARS} | ({SCALARS: rest} if rest else {})
    if tags := _other_tags(grid, parts):
        metadata["tags"] = tags
    mark: dict[str, Any] = {"shape": list(grid.shape), "closed": list(grid.closed), "dims": list(grid.dims)}
    mark["dtype"] = grid.shown.name
    mark["variable"] = next((part.name for part in parts if part.is_main), None)
    mark["attributes"] = {part.name: part.attribute for part in parts if part.attribute is not None}
    return json.dumps(mark | {"metadata": metadata})


def in_json(metadata: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the metadata that JSON can hold, and the keys of the others."""
    kept, lost = {}, []
    for key, value in metadata.items():
        try:
            json.dumps(value)
        except (TypeError, ValueError):
            lost.append(str(key))
        else:
            kept[key] = value
    return kept, lost


def _other_tags(grid: Grid, parts: Sequence[Part]) -> dict[str, Any]:
    """Return the tags that stand in no attribute of the Dataset or of a variable, or are what every one says there."""
    tags = grid.metadata.get("tags")
    if not isinstance(tags, Mapping):
        return {}
    owners = [part.source for part in parts if part.source] + [part.name for part in parts if part.is_number]
    told = {f"{owner}#{key}" for owner in (*owners, _FILE) for key in said_of(grid.metadata, owner)}
    if grid.has_place:
        told |= {f"{MAPPING}#{key}" for key in beside_crs(said_of(grid.metadata, MAPPING))}
    texts = tags.get("")
    usual = _of_every_file(grid.metadata)
    told -= {key for key, text in usual.items() if isinstance(texts, Mapping) and texts.get(key) == text}
    told -= {f"{_FILE}#Conventions", f"{_FILE}#{MARK}"}  # in whose place stand ours
    plain = {k: v for k, v in texts.items() if k not in told} if isinstance(texts, Mapping) else texts
    return {key: value for key, value in {**tags, "": plain}.items() if value}


def _of_every_file(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tags of a Dataset that the layout makes where there are none."""
    return {f"{_FILE}#Conventions": CONVENTIONS, f"{_FILE}#title": metadata.get("name")}


@dataclass(frozen=True)
class Mark:
    """What a mark says.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns as they were.
    closed : (bool, bool)
    dims : (str, str)
    dtype : str
        The type of the points; empty where none is said.
    variable : str or None
        The variable of the heights, or of z.
    attributes : dict of str to str
        Variables of the attributes, with the names that these had.
    metadata : dict
        Without what coordinates and attributes of the conventions say, which somebody may have changed.
    """

    shape: tuple[int, int]
    closed: Closed
    dims: tuple[str, str]
    dtype: str
    variable: str | None
    attributes: dict[str, str]
    metadata: dict[str, Any]

    @classmethod
    def of(cls, attributes: Mapping[str, Any]) -> Mark | None:
        """That of a Dataset with these attributes; None where there is none, or the text is another."""
        try:
            mark = json.loads(attributes[MARK])
            (rows, columns), (high, wide), (first, second) = mark["closed"], mark["shape"], mark["dims"]
            names, metadata, variable = dict(mark["attributes"]), dict(mark["metadata"]), mark.get("variable")
            dtype = mark.get("dtype", "")
            packed(metadata)
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError, InputError):
            return None
        texts = (first, second, dtype, *names, *names.values(), *([] if variable is None else [variable]))
        if not all(isinstance(text, str) for text in texts) or first == second or len({*names.values()}) < len(names):
            return None
        metadata = {key: value for key, value in metadata.items() if key not in _TOLD or key == "tags"}
        return cls((high, wide), (bool(rows), bool(columns)), (first, second), dtype, variable, names, metadata)

    def options(self, dataset: Any) -> dict[str, str]:
        """Return options that choose the surface in a Dataset which still has it."""
        names = {"x": "x", "y": "y"} if self.variable is None else {"variable": self.variable}
        return names if all(_is_wide(dataset, name) for name in names.values()) else {}

    def attributes_in(self, dataset: Any) -> list[str]:
        """Return the variables of attributes that a Dataset still has."""
        return [name for name in self.attributes if _is_wide(dataset, name)]

    def unscaled(self, dataset: Any) -> tuple[Any, Mark]:
        """Return the Dataset with stored numbers of a raster, of which it and the mark say the same scale.

        Where the Dataset has values instead, since xarray has applied the scale, the mark says it no more.
        """
        metadata = dict(self.metadata)
        for name, attribute in ((self.variable, None), *self.attributes.items()):
            scale = scale_of(metadata, attribute)
            attrs = dataset.variables[name].attrs if name is not None and name in dataset.variables else {}
            if scale and {key: attrs.get(key) for key in scale} == scale:
                variable = dataset.variables[name].copy(deep=False)
                variable.attrs = {key: it for key, it in attrs.items() if key not in scale}
                dataset = dataset.assign({name: variable})
            elif scale and attribute is None:
                metadata = {key: it for key, it in metadata.items() if key not in _SCALE}
            elif scale:
                of_band = {key: it for key, it in metadata["bands"][attribute].items() if key not in _SCALE}
                metadata["bands"] = {**metadata["bands"], attribute: of_band}
        return dataset, replace(self, metadata=metadata)

    def is_of(self, choice: Choice) -> bool:
        """Return whether the surface that is chosen is the one that the mark is of."""
        return choice.heights == self.variable

    def closed_in(self, dataset: Any) -> Closed:
        """Return the closed axes that are as long in a Dataset as they were."""
        variable = dataset.variables.get(self.variable, dataset.variables.get("x"))
        if variable is None or variable.ndim < 2:
            return False, False
        known = dict(zip(self.dims, zip(self.closed, self.shape, strict=True), strict=True))
        lengths = dict(zip(variable.dims, variable.shape, strict=True))
        rows, columns = (bool(known.get(dim, (0, 0))[0]) and known[dim][1] == lengths[dim] for dim in variable.dims[:2])
        return rows, columns

    def restored(self, surface: Surface, dataset: Any, choice: Choice) -> dict[str, Any]:
        """Return the metadata of a surface with those of the mark.

        What is true of one shape or order only is left out if the Dataset has another.
        """
        kept, gone = dict(self.metadata), set[str]()
        if choice.shape != self.shape or choice.dims != self.dims:
            gone |= set(_OF_THE_SHAPE)
        if not _in_order(dataset, choice):
            gone |= {*ORDERED, "seam"} if "turn" in kept else set(ORDERED)
        kept = {key: value for key, value in kept.items() if key not in gone}
        metadata, tags = surface.metadata, kept.pop("tags", {})
        tags = tags if isinstance(tags, dict) else {}
        if isinstance(kept.get(SCALARS), dict):
            kept[SCALARS] = {**kept[SCALARS], **metadata.get(SCALARS, {})}
        result = {**metadata, **kept}
        texts = self._texts(surface, metadata | kept, tags.get("", {}))
        types = {self._tag(key): kind for key, kind in metadata.get(TYPES, {}).items()}
        types |= kept[TYPES] if isinstance(kept.get(TYPES), dict) else {}
        others = {key: value for key, value in tags.items() if key}
        for key in ("tags", TYPES):
            result.pop(key, None)
        if types := {key: kind for key, kind in types.items() if key in texts}:
            result[TYPES] = types
        if texts or others:
            result["tags"] = {**others, **({"": texts} if texts else {})}
        for key in ("variable", "nodata"):
            if key in metadata and key not in kept:
                del result[key]  # the name that the layout gave, the number that the writer chose
        return result

    def _tag(self, key: str) -> str:
        """Return the name that a tag of the Dataset had, of a variable that had another name."""
        owner, sharp, name = key.partition("#")
        names = self.attributes
        if isinstance(variable := self.metadata.get("variable"), str) and self.variable is not None:
            names = {**names, self.variable: variable}
        return f"{names.get(owner, owner)}{sharp}{name}"

    def _texts(self, surface: Surface, metadata: Mapping[str, Any], told: Any) -> dict[str, Any]:
        """Return the tags without namespace: those of the file, without what the layout says of every surface."""
        told = told if isinstance(told, dict) else {}
        grid = Grid.of(surface.blocks[0], {**metadata, "tags": {"": told}})
        usual = {
            f"{letter}#{key}": text for letter, said in axis_attributes(grid).items() for key, text in said.items()
        }
        usual |= _of_every_file(self.metadata)
        texts = {self._tag(key): text for key, text in surface.metadata.get("tags", {}).get("", {}).items()}
        return {
            **told,
            **{key: text for key, text in texts.items() if key not in usual or text != text_of(usual[key])[0]},
        }


def _is_wide(dataset: Any, name: str) -> bool:
    """Return whether a Dataset has numbers of this name over two dimensions or more."""
    variable = dataset.variables.get(name)
    return variable is not None and variable.ndim > 1 and is_numeric(variable)


def _in_order(dataset: Any, choice: Choice) -> bool:
    """Return whether rows and columns are those that were numbered, each at its place."""
    numbers = [dataset.variables.get(name) for name in NUMBERS]
    return all(
        given is not None and given.dims == (dim,) and np.array_equal(given.values, np.arange(length))
        for given, dim, length in zip(numbers, choice.dims, choice.shape, strict=True)
    )
