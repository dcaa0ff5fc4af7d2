"""``xarray.open_dataset(..., engine="lode")``: what `lodestream.open` opens, as a lazy Dataset."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

import xarray as xr
from xarray.backends import BackendEntrypoint

from lodestream.errors import InputError, OptionError
from lodestream.interop.lazy_xarray import LazyBlocks
from lodestream.opening import container
from lodestream.target import Region, check_integer

from .requests.addresses import is_served, is_url, published_name

__all__ = ["LodeBackend"]

#: What `xarray.open_dataset` hands to every engine that takes it: how values of a file are decoded.
_DECODERS = (
    *("mask_and_scale", "decode_times", "concat_characters", "decode_coords", "use_cftime", "decode_timedelta"),
)


class LodeBackend(BackendEntrypoint):
    """The engine ``lode`` of xarray, which finds it by its entry point."""

    description = "Open containers of Lodestream (.lode): files, URLs, surfaces of a server, objects in buckets"
    open_dataset_parameters = (
        *("filename_or_obj", *_DECODERS, "drop_variables", "level", "region", "block", "token", "max_vertices"),
    )
    supports_groups = True

    def open_dataset(  # type: ignore[override]  # xarray passes what else the engine takes by keyword
        self,
        filename_or_obj: str | os.PathLike[str],
        *,
        mask_and_scale: bool | Mapping[str, bool] | None = None,
        decode_times: Any = None,
        concat_characters: bool | Mapping[str, bool] | None = None,
        decode_coords: bool | str | None = None,
        use_cftime: bool | Mapping[str, bool] | None = None,
        decode_timedelta: Any = None,
        drop_variables: str | Iterable[str] | None = None,
        level: int | None = None,
        region: Region | None = None,
        block: int | None = None,
        token: str | None = None,
        max_vertices: int | None = None,
    ) -> xr.Dataset:
        """Open one block of a container.

        Parameters
        ----------
        filename_or_obj : str or path-like
            A file, the URL of a file, of a surface of a server, or of a name on a published page, or the address of an
            object in a bucket; see `lodestream.open`.
        mask_and_scale, decode_times, concat_characters, decode_coords, use_cftime, decode_timedelta : optional
            As of `xarray.decode_cf`, which applies those that are given and not false. None: holes are NaN, and other
            values as the container has them: numbers of a raster as stored, dates as numbers.
        drop_variables : str or iterable of str, optional
        level : int, optional
            A coarser level; None: full resolution.
        region : ((int, int), (int, int)), optional
            This window only: rows and columns, half-open, of the full grid at any level. Along a closed axis it may go
            on across the seam, as columns 350:370 of 360.
        block : int, optional
            Of several blocks, the one to open; `open_datatree` opens all.
        token : str, optional
            Token of the server.
        max_vertices : int, optional
            Limit on the memory of what is decoded at once, see `lodestream.Decoder`.

        Raises
        ------
        OptionError
            If a level, region or block is not there, or there are several blocks and none is chosen.
        StreamError, TooLargeError, NotFoundError, RemoteError, UnreachableError
            If the container is damaged or too large, or cannot be had. A note of the error names the file.
        """
        opened = _opened(filename_or_obj, token, max_vertices)
        blocks = len(opened.header.blocks)
        if block is None and blocks > 1:
            raise OptionError(f"expected block= of 0 to {blocks - 1}, or xarray.open_datatree, for {blocks} blocks")
        if block is not None and not 0 <= (block := check_integer("a block", block)) < blocks:
            raise OptionError(f"expected a block of 0 to {blocks - 1}, got {block}")
        given = (mask_and_scale, decode_times, concat_characters, decode_coords, use_cftime, decode_timedelta)
        lazy = LazyBlocks(opened).dataset(level, block or 0, region)
        lazy.set_close(opened.close)
        block_dataset = _decoded(lazy, dict(zip(_DECODERS, given, strict=True)))
        drop = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return block_dataset.drop_vars(drop, errors="ignore")

    def open_datatree(self, filename_or_obj: Any, **options: Any) -> xr.DataTree:
        """Open all blocks of a container, as ``block_0``, ``block_1``, ...; parameters as of `open_dataset`.

        Raises
        ------
        As `open_dataset`.
        """
        return xr.DataTree.from_dict(self.open_groups_as_dict(filename_or_obj, **options))

    def open_groups_as_dict(self, filename_or_obj: Any, **options: Any) -> dict[str, xr.Dataset]:
        """Return the Datasets of all blocks by their path; see `open_datatree`."""
        decoders = {name: options.pop(name, None) for name in _DECODERS}
        drop = options.pop("drop_variables", None) or ()
        level, token = options.pop("level", None), options.pop("token", None)
        max_vertices = options.pop("max_vertices", None)
        if options:
            raise OptionError(f"expected level, token or max_vertices, got {next(iter(options))!r}")
        opened = _opened(filename_or_obj, token, max_vertices)
        names = [drop] if isinstance(drop, str) else list(drop)
        blocks, datasets = LazyBlocks(opened), {}
        for number in range(len(opened.header.blocks)):
            lazy = blocks.dataset(level, number)
            lazy.set_close(opened.close)
            datasets[f"/block_{number}"] = _decoded(lazy, decoders).drop_vars(names, errors="ignore")
        return datasets

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return whether a name ends in ``.lode``, or is the URL of a surface, or of a name that leads to one."""
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        name = os.fspath(filename_or_obj)
        if not isinstance(name, str):
            return False
        if is_url(name):
            page = name.partition("#")[0].partition("?")[0]
            named = page.endswith(("/", ".html")) and published_name(name) is not None
            return page.endswith(".lode") or is_served(name) or named
        return name.endswith(".lode")


def _decoded(data: xr.Dataset, decoders: Mapping[str, Any]) -> xr.Dataset:
    """Return a Dataset decoded in the ways that are given, lazily; see `xarray.decode_cf`."""
    given = {name: way for name, way in decoders.items() if way is not None}
    if not any(given.values()):
        return data
    times = {"decode_times": False, "decode_timedelta": False, "mask_and_scale": False, "concat_characters": False}
    decoded: xr.Dataset = xr.decode_cf(data, **{**times, "decode_coords": False, **given})
    decoded.set_close(data._close)
    return decoded


def _opened(name: Any, token: str | None, max_vertices: int | None) -> container.Container:
    if not isinstance(name, str | os.PathLike):
        raise InputError(f"expected a file's name or a URL for engine lode, got {type(name).__name__}")
    return container.open(name, token=token, max_vertices=max_vertices)
