"""The libraries of the extra ``remesh``, imported on use."""

from __future__ import annotations

import importlib
import os
from typing import Any

from ..errors import UnavailableError
from ..parallel import threads

__all__ = ["igl", "sparse"]


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise  # it is there, and lacks something itself
        raise UnavailableError(
            f"expected {error.name} to remesh triangles, which is not installed: pip install 'lodestream[remesh]'"
        ) from None


def igl() -> Any:
    """libigl: closest points.

    Raises
    ------
    UnavailableError
        If it is not installed.
    """
    # Else it begins as many threads as the machine has processors, which a confined process may not.
    os.environ["IGL_NUM_THREADS"] = str(threads())
    return _library("igl")


def sparse() -> Any:
    """scipy.sparse: matrices of linear systems, graphs and matchings.

    Raises
    ------
    UnavailableError
        If it is not installed.
    """
    return _library("scipy.sparse")
