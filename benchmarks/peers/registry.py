"""The coders that are measured: where each is called, and its version. Nothing heavy is imported from here."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterable
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .trial import Trial

__all__ = ["MESHES", "OURS", "PEERS", "function_of", "old", "versions"]

OURS = "Lodestream"

#: Name in the tables: module of this package, and function there that takes a `Trial`.
PEERS = {
    "SPERR, one stream for each error": ("floats", "sperr_psnr"),
    "SPERR, prefixes of one stream": ("floats", "sperr_prefix"),
    "SPERR, maximum error": ("floats", "sperr_bound"),
    "SZ3": ("floats", "sz3"),
    "ZFP": ("floats", "zfp"),
    "LERC": ("floats", "lerc"),
    "PyWavelets bior4.4 + bzip2": ("floats", "wavelets"),
    "JPEG 2000 9/7, layers": ("jpeg2000", "irreversible"),
    "JPEG 2000 5/3, layers": ("jpeg2000", "reversible"),
    "HTJ2K": ("images", "htj2k"),
    "JPEG XL, efforts 9 and 10": ("images", "jpegxl"),
    "JPEG XL, lossy": ("images", "jpegxl_lossy"),
    "JPEG-LS": ("images", "jpegls"),
    "pcodec": ("images", "pcodec"),
    "meshoptimizer": ("images", "meshoptimizer"),
    "Draco, points": ("draco", "points"),
    "Draco, edgebreaker": ("draco", "edgebreaker"),
}

#: Peers that are made for meshes; all others code whole numbers or floating point.
MESHES = ("meshoptimizer", "Draco, points", "Draco, edgebreaker")

#: The first versions with the libraries of 2026-10: JPEG XL 0.12, SZ3 3.4.
_NEWEST = {"imagecodecs": "2026.10"}

_CODECS = ("sperr", "sz3", "zfp", "lerc", "htj2k", "jpegxl", "jpegls", "pcodec", "meshopt")
_PACKAGES = ("numpy", "imagecodecs", "glymur", "DracoPy", "PyWavelets")


def function_of(peer: str) -> Callable[[Trial], None]:
    """The function that measures a coder; importing it imports the coder."""
    module, name = ("ours", "ours") if peer == OURS else PEERS[peer]
    found: Callable[[Trial], None] = getattr(importlib.import_module(f"benchmarks.peers.{module}"), name)
    return found


def old(told: Iterable[str]) -> list[str]:
    """Of what `versions` told, the packages that there are newer ones of."""
    found = []
    for package in told:
        name, _, number = package.partition(" ")
        newest = _NEWEST.get(name)
        if newest is not None and _parts(number) < _parts(newest):
            found.append(package)
    return found


def _parts(number: str) -> list[int]:
    return [int(part) for part in number.split(".") if part.isdigit()]


def versions() -> list[str]:
    """Versions of the peers' packages, and of the libraries within, where they are installed."""
    found = []
    for package in _PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} not installed")
    with contextlib.suppress(ImportError):
        imagecodecs = importlib.import_module("imagecodecs")
        found += [str(getattr(imagecodecs, f"{codec}_version")()) for codec in _CODECS]
        found.append(f"OpenJPEG {importlib.import_module('glymur').version.openjpeg_version}")
    return found
