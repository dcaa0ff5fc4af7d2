"""The coders that are measured: where each is called, and its version. Nothing heavy is imported from here."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .trial import Trial

__all__ = ["OURS", "PEERS", "function_of", "versions"]

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
    "JPEG XL, effort 9": ("images", "jpegxl"),
    "JPEG XL, lossy": ("images", "jpegxl_lossy"),
    "JPEG-LS": ("images", "jpegls"),
    "pcodec": ("images", "pcodec"),
    "meshoptimizer": ("images", "meshoptimizer"),
    "Draco, points": ("draco", "points"),
    "Draco, edgebreaker": ("draco", "edgebreaker"),
}

_CODECS = ("sperr", "sz3", "zfp", "lerc", "htj2k", "jpegxl", "jpegls", "pcodec", "meshopt")
_PACKAGES = ("numpy", "imagecodecs", "glymur", "DracoPy", "PyWavelets")


def function_of(peer: str) -> Callable[[Trial], None]:
    """The function that measures a coder; importing it imports the coder."""
    module, name = ("ours", "ours") if peer == OURS else PEERS[peer]
    found: Callable[[Trial], None] = getattr(importlib.import_module(f"benchmarks.peers.{module}"), name)
    return found


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
