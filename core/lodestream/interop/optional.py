"""Optional libraries: imported on use, with an error that names the extra that installs them."""

from __future__ import annotations

import importlib
from typing import Any

from ..errors import UnavailableError

__all__ = ["require_library"]


def require_library(name: str, extra: str) -> Any:
    """Return a module of another library.

    Parameters
    ----------
    name : str
        Of the module, such as "xarray".
    extra : str
        What installs it: ``lodestream[extra]``.

    Raises
    ------
    UnavailableError
        If it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise  # it is there, and lacks something itself
        raise UnavailableError(f"expected {name}, which is not installed: pip install 'lodestream[{extra}]'") from None
