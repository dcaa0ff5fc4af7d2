"""A separate process that reads one file with a reader of VTK and writes its grids to standard output.

VTK takes what memory a file asks for, ends the process when it gets none, and CGNS opens the files that a file names.
Here it may have only so much memory, may have no second file open beside the one that it reads, and where the kernel
sees to it (`lodestream.confinement`) may open no other file but libraries, no socket, and start nothing. This script
stands alone, so that starting it loads nothing but VTK and NumPy.

Output: a line of JSON, {"grids": [{"dims", "arrays"}]} or {"error"}, and then the arrays' bytes in the same order.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
from vtkmodules.vtkCommonMisc import vtkErrorCode
from vtkmodules.vtkIOCGNSReader import vtkCGNSReader
from vtkmodules.vtkIOLegacy import vtkRectilinearGridReader, vtkStructuredGridReader
from vtkmodules.vtkIOXML import vtkXMLStructuredGridReader

sys.path.append(os.fspath(Path(__file__).parents[3]))  # of which the package itself loads nothing else
from lodestream.confinement import Rights, confine
from lodestream.operating_system import limit_files, limit_memory, limit_processor

_READERS: dict[str, Any] = {
    "structured": vtkStructuredGridReader,
    "rectilinear": vtkRectilinearGridReader,
    "xml": vtkXMLStructuredGridReader,
    "cgns": vtkCGNSReader,
}

#: Strings of field data that say something of the surface.
_WORDS = ("name", "unit", "crs")

#: Field data that are of no use here: VTK adds the first to what it reads from CGNS, `Surface.to_pyvista` the second.
_PASSED_OVER = ("Base/Zone", "lodestream")

_MAX_SECONDS = 600


def main(kind: str, path: str, budget: int, seconds: int) -> None:
    """Read the file `path` with the reader `kind`, in so many bytes beside those of VTK, and processor seconds."""
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    messages = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(messages)
    _limit(budget, seconds, Path(path))
    errors: list[str] = []
    reader = _READERS[kind]()
    reader.AddObserver("ErrorEvent", lambda *_: errors.append("error"))
    reader.SetFileName(path)
    if kind == "cgns":
        reader.UpdateInformation()
        reader.EnableAllBases()
        reader.EnableAllFamilies()
        reader.EnableAllPointArrays()
    elif kind != "xml":
        for name in ("Scalars", "Vectors", "Normals", "TCoords", "Fields"):
            getattr(reader, f"ReadAll{name}On")()
    reader.Update()
    text = messages.GetOutput() or ""
    if errors or re.search(r"\bERR(OR)?\b|Error reading", text) or reader.GetErrorCode():
        code = vtkErrorCode.GetStringFromErrorCode(reader.GetErrorCode())
        unknown = "what it cannot read (links to other files are never followed)"
        reasons = (_first_message(text), code, unknown)
        _answer({"error": next(reason for reason in reasons if reason not in ("", "Success", "NoError"))})
        return
    grids, arrays = [], []
    for data in _leaves(reader.GetOutputDataObject(0)):
        if data.GetClassName() not in ("vtkStructuredGrid", "vtkRectilinearGrid"):
            _answer({"error": f"a {data.GetClassName()}, which is no structured grid"})
            return
        described, values = _grid(data)
        grids.append(described)
        arrays.append(values)
    if kind == "cgns" and grids:
        grids[0]["left_out"] += [reader.GetCellArrayName(it) for it in range(reader.GetNumberOfCellArrays())]
        grids[0]["left_out"] += [reader.GetFaceArrayName(it) for it in range(reader.GetNumberOfFaceArrays())]
    _answer({"grids": grids})
    for values in arrays:
        for array in values:
            sys.stdout.buffer.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    sys.stdout.buffer.flush()


def _limit(budget: int, seconds: int, path: Path) -> None:
    """Limit memory and processor time, allow one open file more, only this one, and end with the parent."""
    limit_memory(budget)
    limit_processor(min(seconds, _MAX_SECONDS))
    confine(Rights(read=(path,)))
    limit_files(1)


def _leaves(data: Any) -> Iterator[Any]:
    if data is None:
        return
    if not data.IsA("vtkCompositeDataSet"):
        yield data
        return
    iterator = data.NewIterator()
    iterator.InitTraversal()
    while not iterator.IsDoneWithTraversal():
        yield iterator.GetCurrentDataObject()
        iterator.GoToNextItem()


def _grid(data: Any) -> tuple[dict[str, Any], list[Any]]:
    """Return the description of a grid and its arrays, those of its points first."""
    extent = data.GetExtent()
    dims = [extent[axis + 1] - extent[axis] + 1 for axis in (0, 2, 4)]
    if data.IsA("vtkRectilinearGrid"):
        axes = (data.GetXCoordinates(), data.GetYCoordinates(), data.GetZCoordinates())
        named = [("axis", letter, vtk_to_numpy(axis)) for letter, axis in zip("ijk", axes, strict=True)]
    else:
        points = data.GetPoints()
        named = [("points", "", vtk_to_numpy(points.GetData()))] if points is not None else []
    left_out, words = [], {}
    fields = data.GetFieldData()
    for index in range(fields.GetNumberOfArrays()):
        array, name = fields.GetAbstractArray(index), fields.GetArrayName(index) or f"field_{index}"
        if name in _PASSED_OVER:
            continue
        if name in _WORDS and array.IsA("vtkStringArray") and array.GetNumberOfValues() == 1:
            words[name] = array.GetValue(0)
        else:
            left_out.append(name)
    for role, attributes in (("point", data.GetPointData()), ("cell", data.GetCellData())):
        for index in range(attributes.GetNumberOfArrays()):
            array = attributes.GetArray(index)
            name = attributes.GetArrayName(index) or f"array_{index}"
            if name == "vtkGhostType" and array is not None:
                named.append((f"{role}_ghost", name, vtk_to_numpy(array)))
            elif role == "point" and array is not None and not array.IsA("vtkBitArray"):
                named.append((_role(attributes, array), name, vtk_to_numpy(array)))
            else:
                left_out.append(name)
    arrays = [
        {"role": role, "name": name, "dtype": values.dtype.str, "shape": values.shape} for role, name, values in named
    ]
    return {"dims": dims, "arrays": arrays, "left_out": left_out, "words": words}, [values for _, _, values in named]


def _role(attributes: Any, array: Any) -> str:
    """Return the role that the file gives an array."""
    for role, getter in (("normals", "GetNormals"), ("texture", "GetTCoords"), ("scalars", "GetScalars")):
        if getattr(attributes, getter)() is array:
            return role
    return "point"


def _first_message(text: str) -> str:
    """Return the text of VTK's first error, without its place in VTK's source."""
    for line in text.splitlines():
        words = line.split("): ", 1)[-1].strip()
        if words and not words.startswith(("ERROR:", "Warning:", "Generic Warning:", "ERR|")):
            return re.sub(r" \(0x[0-9a-f]+\)", "", words)
    return ""


def _answer(answer: dict[str, Any]) -> None:
    sys.stdout.buffer.write(json.dumps(answer).encode() + b"\n")
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
