"""Why cells lose, by their kind: it stands below the tables."""

from __future__ import annotations

from .curves import SMALL, Cell

__all__ = ["REMARKS", "TERRACES", "remark_of"]

REMARKS: dict[str, str] = {
    "few bytes": """\
Less than 4 KB in all, of which the header and the frames of layers are a good part. SPERR's 9/7 filters are longer than
those of the optimal hierarchy.""",
    "tiny": """\
At most 64 x 64 points: the header and the start of the contexts are most of the stream. The aims are for larger
surfaces.""",
    "quantised values": """\
The peer codes integers, quantised with the step that just meets the error, with predictors and contexts chosen for
this surface. It shows nothing before its end. Ours is a stream for this one error, with a trellis: 5 to 20 % smaller
than one exact stream.""",
    "terraces": """\
A map of heights in 8 bits that takes 153 of the 256 values; two neighbours in three are equal. The peer's tree of
predictors expresses this exactly, while the optimal hierarchy spreads each edge of a terrace over its levels. A stream
of a few rough layers and then all values at once took 30 % fewer bytes here. It was removed, since it was not
progressive (`docs/experiments.md`). Finer classes of contexts gain nothing; a precision below the step of the values
does not help.""",
    "transforms": """\
The peer is a wavelet coder with longer filters (9/7) and its rates are chosen after coding.""",
    "maximum": """\
Not an aim. A maximum error is met by quantising all values, as a precision does. Before the end of an embedded stream
the maximum error is at least four times the RMS error.""",
    "noise": """\
Nothing can be predicted, and what differs is the cost of adapting and of frames (about 1 %); the transform turns
white noise into noise that is not quite white. At 1e-2 the error lies just below the noise's own: the peer's bytes
there are interpolated between two of its settings that are a factor of ten apart.""",
}

TERRACES = ("gcanyon_elev_crop.bw.png",)
_WAVELETS = ("JPEG 2000", "SPERR", "HTJ2K", "PyWavelets")


def remark_of(group: str, kind: str, cell: Cell) -> str:
    """The key of the remark on a cell."""
    if group in ("tiny", "noise"):
        return group
    if kind == "max":
        return "maximum"
    if cell.surface in TERRACES:
        return "terraces"
    if cell.peer_bytes < SMALL:
        return "few bytes"
    return "transforms" if cell.peer.startswith(_WAVELETS) else "quantised values"
