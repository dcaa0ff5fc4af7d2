"""What is no grid in a Dataset: unstructured meshes, lists of cells, and files of other things.

Sources: UGRID conventions 1.0; the manuals of MPAS, ICON, FVCOM, ESMF, SCRIP, Exodus II, BOOZ_XFORM and AMBER.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from .names import is_geographic_coordinate, letters_of

__all__ = ["NoGrid", "no_grid_of"]

#: Names of tables of vertex numbers: of MPAS, ICON, FVCOM, ADCIRC, ESMF, Exodus II and SCHISM.
_TABLE = re.compile(
    r"(cells|vertices|edges)On(Cell|Vertex|Edge)|(vertex|edge|neighbor_cell|adjacent_cell)(_index)?_of_\w+|"
    r"nv|nbe|elements?|triangles?|elementConn|connect\d*|\w*_?(face|edge|elem|element|cell)_?(nodes|edges|connectivity)",
    re.IGNORECASE,
)

#: A table of vertex numbers has so many columns at most.
_MOST_CORNERS = 16

_MESH = "an unstructured mesh"
_ADVICE = "only grids of rows and columns can be read, to which other programs can interpolate"

_OLD_GMT = "a grid of GMT before version 4"
_CONVERSION = "gmt grdconvert writes it as the CF conventions have it"

#: Files that are told by variables that they have together.
_BY_VARIABLES = {
    ("ixm_b", "ixn_b"): "Fourier coefficients in Boozer coordinates (BOOZ_XFORM)",
    ("grid_center_lat", "grid_corner_lat", "grid_dims"): "a list of cells (SCRIP)",
    ("x_range", "y_range", "spacing", "dimension", "z"): _OLD_GMT,
}

#: Texts of attributes of a file.
_BY_ATTRIBUTES = {("Conventions", "amber"): "a trajectory of molecules (AMBER)"}


@dataclass(frozen=True)
class NoGrid:
    """Something in a Dataset that is no grid.

    Attributes
    ----------
    words : str
        What it is.
    dims : frozenset of str
        The dimensions that belong to it: variables over them lie on no grid.
    names : frozenset of str
        Variables that describe it.
    whole : bool
        Whether the Dataset is nothing else.
    advice : str
        What to do with it.
    """

    words: str
    dims: frozenset[str] = frozenset()
    names: frozenset[str] = frozenset()
    whole: bool = False
    advice: str = _ADVICE

    def takes(self, name: str, dims: Any) -> bool:
        """Return whether a variable of this name, over these dimensions, belongs to it."""
        return self.whole or name in self.names or bool(self.dims & set(map(str, dims)))

    def refusal(self, name: str = "") -> str:
        """Return words of an error about the whole, or about a variable of it."""
        belongs = f", to which {name} belongs" if name else ""
        return f"expected a variable over a grid, got {self.words}{belongs}: {self.advice}"


def no_grid_of(dataset: Any) -> NoGrid | None:
    """Find what is no grid in a Dataset; None: nothing is known to be."""
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    for names, words in _BY_VARIABLES.items():
        if set(names) <= set(variables):
            return NoGrid(words, whole=True, advice=_CONVERSION if words == _OLD_GMT else _ADVICE)
    for (key, text), words in _BY_ATTRIBUTES.items():
        if text in str(dataset.attrs.get(key, "")).lower():
            return NoGrid(words, whole=True)
    for variable in variables.values():
        if str(variable.attrs.get("grid_mapping_name", "")).lower() == "healpix":
            cells = {str(dim) for it in variables.values() if "grid_mapping" in it.attrs for dim in it.dims[-1:]}
            return NoGrid("a HEALPix map, whose cells are no grid", frozenset(cells))
    tables = set(_tables(variables))
    if not tables:
        return _scattered(dataset)
    # A table runs over the cells, or edges, of a mesh. Its columns, the corners of one, are of no other variable.
    dims = {str(dim) for name in tables for dim in variables[name].dims} | _lists_of_points(dataset)
    known = {str(variable.attrs.get("cf_role", "")) for variable in variables.values()}
    coordinates = {word for it in variables.values() for word in _coordinates_of_mesh(it)} & set(variables)
    lists = [it for name, it in variables.items() if name in coordinates or "mesh" in it.attrs]
    dims |= {str(it.dims[-1]) for it in lists if it.dims and it.ndim == 1}
    words = f"{_MESH} (UGRID)" if "mesh_topology" in known else _MESH
    return NoGrid(words, frozenset(dims), frozenset(tables))


def _scattered(dataset: Any) -> NoGrid | None:
    """Return variables over a dimension that has both a longitude and a latitude, as of ICON, or None.

    Longitudes and latitudes over that dimension and another are those of a grid, which the others belong to.
    """
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    cells = {
        str(it.dims[-1])
        for it in variables.values()
        if it.ndim and str(it.attrs.get("CDI_grid_type", "")).lower() == "unstructured"
    }
    letters = {
        name: letter for name, letter in letters_of(dataset).items() if is_geographic_coordinate(variables[name])
    }
    on_grids = [{letters[name]: set(map(str, variables[name].dims))} for name in letters if variables[name].ndim > 1]
    gridded = {letter: set().union(*(dims[letter] for dims in on_grids if letter in dims)) for letter in ("x", "y")}
    lists: dict[str, set[str]] = {}
    for name, letter in letters.items():
        if variables[name].ndim == 1:
            lists.setdefault(str(variables[name].dims[0]), set()).add(letter)
    points = {dim for dim, both in lists.items() if len(both) == 2 and dim not in gridded["x"] & gridded["y"]}
    if cells:
        return NoGrid(_MESH, frozenset(cells | points))
    words = f"a list of points, of which each has its longitude and latitude along {', '.join(sorted(points))}"
    return NoGrid(words, frozenset(points)) if points else None


def _tables(variables: dict[str, Any]) -> Iterator[str]:
    """Yield names of tables of connectivity: the conventions say so, or their names do."""
    named = {
        word
        for variable in variables.values()
        if variable.attrs.get("cf_role") == "mesh_topology"
        for key, text in variable.attrs.items()
        if str(key).endswith("_connectivity")
        for word in str(text).split()
    }
    for name, variable in variables.items():
        role = str(variable.attrs.get("cf_role", ""))
        if name in named or role.endswith("_connectivity"):
            yield name
        elif not _TABLE.fullmatch(name) or variable.dtype.kind not in "iu" or variable.ndim != 2:
            continue
        elif min(variable.shape) <= _MOST_CORNERS:
            yield name


def _coordinates_of_mesh(variable: Any) -> list[str]:
    if variable.attrs.get("cf_role") != "mesh_topology":
        return []
    return [
        word for key, text in variable.attrs.items() if str(key).endswith("_coordinates") for word in str(text).split()
    ]


def _lists_of_points(dataset: Any) -> set[str]:
    """Return dimensions along which there is both an x and a y."""
    letters: dict[str, set[str]] = {}
    for name, letter in letters_of(dataset).items():
        variable = dataset.variables[name]
        if variable.ndim == 1:
            letters.setdefault(str(variable.dims[0]), set()).add(letter)
    return {dim for dim, both in letters.items() if len(both) == 2}
