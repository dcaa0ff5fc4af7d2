"""Open the source of a widget, as a container that is read part by part."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

import lodestream as ls
from lodestream.container import Header
from lodestream.container.sections import MAGIC
from lodestream.errors import InputError, OptionError
from lodestream.opening.byte_sources import ByteSource, MemorySource
from lodestream.opening.container import Container
from lodestream.opening.open_source import is_address, open_source
from lodestream.quality import Quality
from lodestream.surface import Surface
from lodestream.target import Target

__all__ = ["field_names", "limit_of", "opened"]

#: What is called by one name each in the viewer, beside attributes.
_FIELDS = ("height", "slope", "change", "none")

#: Components of one attribute that the viewer offers.
_MOST_COMPONENTS = 16


def opened(
    source: Any, *, token: str | None = None, quality: Quality | None = None, name: str | None = None
) -> Container:
    """Open the source of a widget, and read its header and index.

    Parameters
    ----------
    source : Surface, array, bytes, str or path-like
        See `Widget`.
    token : str or None
        Of the server of a URL.
    quality : Quality or None
        How closely what is not a container yet is encoded; None: exactly.
    name : str or None
        In place of the source's own.

    Raises
    ------
    InputError
        If it is something else, an option does not go with it, or a file cannot be read.
    OSError
        If there is no such file.
    StreamError, TooLargeError, NotFoundError, RemoteError, UnreachableError
        If the container is damaged or too large, or cannot be had.
    """
    remote = is_address(source)
    if token is not None and not remote:
        raise OptionError(f"expected a URL, to whose server the token belongs, got {_kind(source)}")
    chosen = open_source(source, token) if remote else _local(source, quality)
    if quality is not None and not (isinstance(chosen, MemorySource) and not isinstance(source, bytes | bytearray)):
        chosen.close()
        raise OptionError("expected a surface to encode with this quality, got a container, which is shown as it is")
    if name is not None:
        chosen.name = name
    return Container(chosen)


def _local(source: Any, quality: Quality | None) -> ByteSource:
    if isinstance(source, bytes | bytearray | memoryview):
        return open_source(source)
    if isinstance(source, Surface | np.ndarray):
        return _encoded(source, quality, "")
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if not path.is_dir():  # as a Zarr store is
            with path.open("rb") as file:
                if file.read(len(MAGIC)) == MAGIC:
                    return open_source(path)
        return _encoded(ls.read(path), quality, path.stem)
    hint = "; a view has surface()" if isinstance(source, ls.View) else ""
    raise InputError(
        "expected a Surface, an array of points, a container as bytes, the path of a file or a URL, "
        f"got {_kind(source)}{hint}"
    )


def _encoded(surface: Surface | np.ndarray[Any, Any], quality: Quality | None, name: str) -> ByteSource:
    data = ls.encode(surface, quality=quality)
    surface_name = surface.metadata.get("name") if isinstance(surface, Surface) else None
    return MemorySource(data, surface_name if isinstance(surface_name, str) and surface_name else name)


def _kind(source: Any) -> str:
    return repr(source) if isinstance(source, str) else type(source).__name__


def field_names(header: Header) -> list[str]:
    """Return the fields by which a surface can be coloured.

    Kinds, attributes (a vector's length), and their components.
    """
    names = [*_FIELDS, *(f"channel {channel}" for channel in range(3, header.point_channels))]
    for kind in header.attributes:
        names.append(kind.name)
        if kind.channels > 1:
            names += [f"{kind.name}[{component}]" for component in range(min(kind.channels, _MOST_COMPONENTS))]
    return names


def limit_of(target: Target | None, header: Header) -> dict[str, float]:
    """Return a target as the viewer takes it: at most one limit, errors in the surface's unit.

    Raises
    ------
    OptionError
        If it has several limits, or anything else than a limit, or the surface has no such level.
    """
    if target is None:
        return {}
    if not isinstance(target, Target):
        raise OptionError(f"expected a lodestream.Target or None, got {type(target).__name__}")
    others = (target.seconds, target.region, target.attributes, target.first)
    limits: dict[str, float] = {
        key: error.absolute(header.extent)
        for key, error in zip(("rms", "max"), target.whole, strict=True)
        if error is not None
    }
    if target.max_bytes is not None:
        limits["bytes"] = target.max_bytes
    if target.level is not None:
        if target.level > header.levels:
            raise OptionError(f"expected a level of 0 to {header.levels}, got {target.level}")
        limits["level"] = target.level
    if len(limits) > 1 or target.channels or any(other is not None for other in others) or target.order != "quality":
        raise OptionError(
            "expected a target of one limit (level, until_rms or until_max of the whole surface, or max_bytes) and "
            f"nothing else, as the viewer has it, got {target}"
        )
    return limits
