"""The words of ``docs/benchmarks.md`` that do not depend on what was measured."""

from __future__ import annotations

__all__ = ["GATES", "LOSSLESS", "MEMORY", "RULES", "SPEED"]

RULES = """\
- A cell is one error on one surface. Errors are relative to the range of heights or to the diagonal of the box, of
  distances in space for x, y, z, and measured on what was decoded, ours like the peers'.
- A peer counts at the best of its settings and modes, and the best peer of each cell is compared.
- Ours stands there twice. *One exact stream* is made once, without naming an error, and stopped where its error is
  small enough: what Lodestream is made for. *At its best setting* is the best of that and of streams made for one
  error, as the peers' are: `rms`, the stream for that RMS error (`lodestream encode --rms`), and `precision`, which is
  sqrt(3) times the RMS error, or the maximum error itself (whole heights of integer type go in steps of odd size
  instead). The aims are held against the best setting, since that is what the peers have; the figures of one exact
  stream stand beside them everywhere. `each error` among the settings: interpolated between the ends of such streams,
  as a peer's settings are.
- Bytes are interpolated between settings, or between the layers of one stream, in log-log on the lower envelope. An
  error below the last lossy one costs the lossless stream. A peer's stream that does not itself say shape, type and how
  its numbers become values counts 32 bytes more.
- Planes of x, y, z are coded one after another where a peer takes planes, with the same absolute error in each. Coders
  of whole numbers are given the values' own lattice where there is one and, for larger errors, values quantised with
  the very step that meets the error. Coders of floating point are given float32, and for lossless the type itself.
- Surfaces of more than four million samples are tried at fewer settings, ours too.
- A ratio below 1 says that ours needs fewer bytes; **bold**: it loses. Means are geometric, over cells where the best
  peer needs 4 KB or more."""

GATES = """\
Means, worst ratios and the aims are of cells of 4 KB or more, and the aims are for the best setting. Bold here: worse
than the aim, or than 1 where there is none (means), or than 1 (worst). No cell should lie above 1.03, and none below
4 KB more than 600 bytes above the peer."""

SPEED = """
MB are those of the samples as float32, whatever their type; geometric means over the surfaces, without the tiny ones;
one core. *At 1e-4*: the setting whose RMS error is nearest, where one is within a factor of 3; for streams of layers or
prefixes encoding is that of the whole stream. Ours is the exact stream: encoding measures the errors of every layer
and level, decoding at 1e-4 is that of a prefix. Times are the best of three where they are short, else single. A
coder is measured again only where it changed, and this machine is shared: ours was last measured at another hour than
most peers, with two to four times as many busy processes as cores, so our speeds are lower here than on an idle machine
(those of [measurements.md](measurements.md) are of one run). Bytes and memory know nothing of that."""

MEMORY = """
Peak above what the process held with the surface loaded, largest over the settings, as a multiple of the samples as
float32. The way from values to whole numbers and back, as float64, is the peer's where it is needed. What a process had
freed before and kept may hide a part of a peak."""

LOSSLESS = """
Every value comes back bit for bit. *Ours* is what a receiver gets until then; the whole file also has metadata and the
index. A dash: the peer cannot, since the values lie on no lattice of 16 bits. What loses here, apart from what the
cells below say: of bijou's float64 values 98 % are float32 numbers, the rest are not, and pcodec finds that out while
our residual does not."""
