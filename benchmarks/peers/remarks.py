"""What was tried against cells that lose, by their kind: it stands below the tables."""

from __future__ import annotations

from .curves import SMALL, Cell

__all__ = ["REMARKS", "TERRACES", "remark_of"]

REMARKS: dict[str, str] = {
    "few bytes": """\
Less than 4 KB in all, of which the header and the frames of layers are a good part. Tried: a stream for this one
error, with three layers (kept), shorter headers (kept), trained contexts (kept). Starting every tile with
its own final model, the best that any initial table could be, would save 1 to 2 % here; showing insignificant
coefficients by linear prediction lowers the RMS by 0.5 to 2 %. SPERR's 9/7 filters are longer than those of the
optimal hierarchy.""",
    "tiny": """\
At most 64 x 64 points: the header and the start of the contexts are most of the stream. Tried: as for few bytes;
longer tiles on narrow surfaces, and models shared by small parts (both kept). The aims are for larger
surfaces.""",
    "quantised values": """\
The peer codes whole numbers, quantised with the very step that meets the error, by predictors and contexts chosen
for this surface, and gives nothing before its end. Tried: a stream for this one error, with a trellis (kept as the
setting: 5 to 20 % less than one exact stream); whole numbers by their neighbours in raster order, as the peer does
it (left out: such a stream has no layers, see `docs/experiments.md`); signed sums of neighbours as contexts (+0.3 %);
finer classes of the ring, with the kind of band (+0.1 %); the ring mixed in for higher planes (-0.1 %, a tenth slower); other rates of learning (within
0.05 %); surer probabilities (-0.03 %); another lifting step within bands against what is left of correlation (1 to 5
% worse at medium rates, nothing at the end).""",
    "terraces": """\
A map of heights in 8 bits that are 153 of the 256 values, where two neighbours in three are equal: the peer's tree of
predictors says so exactly, while the optimal hierarchy spreads each edge of a terrace over its levels. A stream of rough
layers and then everything at once took 30 % fewer bytes here and was left out: a progressive stream is progressive,
always (`docs/experiments.md`). Finer classes of contexts (as above) gain nothing; a precision is no help below the
values' own step.""",
    "transforms": """\
The peer is a wavelet coder with longer filters (9/7) and its rates are chosen after coding. Tried: layers that end
where the error has just fallen (kept, up to 6 %); weights of bands other than the norms of their synthesis (no
gain); reconstruction points for each tile and class (0.2 %, left out); a stream for this one error (kept as the
setting).""",
    "maximum": """\
Not an aim. A maximum is met by coding all values quantised, which is what a precision does; before its end the
largest error of an embedded stream is four times its RMS and more. Tried: a precision for the maximum (kept as the
setting). What was tried about quantised values holds here too.""",
    "noise": """\
Nothing can be foretold, and what differs is the cost of adapting and of frames (about 1 %); the transform turns
white noise into noise that is not quite white. Tried: storing values rather than coding them, where that is shorter
(kept, it is the bound of the stream's length). At 1e-2 the error lies just below the noise's own: the peer's bytes
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
