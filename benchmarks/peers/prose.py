"""The words of ``docs/benchmarks.md`` that do not depend on what was measured."""

from __future__ import annotations

__all__ = ["GATES", "LINKS", "LOSSLESS", "MEMORY", "NOT_MEASURED", "RESAMPLED", "RULES", "SECONDS", "SPEED"]

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

SECONDS = """\
How long a receiver waits for points with an RMS error, or for every value: the bytes over the link, and decoding them,
on one core. The link is one in figures: no handshake, no round trip, nothing lost.

- *Ours* is the one exact stream, made without naming an error, decoded layer by layer as it arrives: a layer when it
  has come and the ones before are decoded, its segments when 8 KiB of them wait (`View.prepare`). At the first layer
  with the error the points are made, once. So what is counted after the last byte is that layer, the segments that
  wait, and the points.
- *A peer* sends the stream that meets the error, and it is decoded when it is there. Each coder has all its settings
  and what lies between two of them; the best of all coders is taken in each cell. What turns whole numbers back into
  values is not counted, where a coder has whole numbers; ours gives values.
- Seconds of decoding are those of the processor, the least of several times: the machine may be shared.
- A ratio below 1 says that ours is there first. Means are geometric, over all cells. **Bold**: a mean or a worst cell
  that misses its aim, or a cell above 1.
- `by the script`: the mean as `../shared/bench/time_to_error.py` counts, with its fewer peers, nothing between their
  settings, and as if all our decoding happened while bytes arrive. The aims are held against the stricter figure before
  it."""

LINKS = """\
Seconds by the clock from the connection to the points, over links that a proxy emulates: so many bits a second towards
the client, half the round trip either way, without TCP's handshake and slow start. Nothing is reckoned here.

- *Ours* comes from `lodestream serve` by the Python client over WebSocket, one exact stream in the server's default
  form, stopped at the error.
- Each peer's file is its smallest that was found to meet the error, by HTTP from Python's own server, decoded by the
  same process once it is there. Its coder needs to know the error beforehand; ours is one stream for all.
- `raw`: the array's own bytes by HTTP; they are exact, whatever the error.
- Server, proxy and client share the machine, so speeds of links above what it can carry are not reached, and whatever
  else it does counts. `of processors`: what the client's own process computed.
- At 1 Mbit/s all was received once, else medians of three are told, in which all take turns."""

NOT_MEASURED = """\
- **Intra frames of AV1, HEVC and VVC** at 10 to 12 bits: they need 0.7 to 1.2 of our bytes at an RMS error of 1e-2 of
  terrain. Their streams have one error; they cannot be refined.
- **HPEZ**: for some maximum errors it needs 0.8 to 0.9 of the bytes of the best other coder. Neither can it be refined.

These two figures were found elsewhere, and not by this program: no package brings either to it."""

GATES = """\
Means, worst ratios and the aims are of cells of 4 KB or more, and the aims are for the best setting. Bold here: worse
than the aim, or than 1 where there is none (means), or than 1 (worst). No cell should lie above 1.03, and none below
4 KB more than 600 bytes above the peer."""

SPEED = """
MB are those of the samples as float32, whatever their type; geometric means over the surfaces, without the tiny ones;
one core. *At 1e-4*: the setting whose RMS error is nearest, where one is within a factor of 3; for streams of layers or
prefixes encoding is that of the whole stream. Ours is the exact stream: encoding measures the errors of every layer
and level, decoding at 1e-4 is that of a prefix. Times are those of the processor, the best of three
where they are short, else single, without the way from whole numbers back to values. A coder is measured again only
where it changed, maybe at another hour; others who use the machine slow its processors down too."""

MEMORY = """
Peak above what the process held with the surface loaded, largest over the settings, as a multiple of the samples as
float32. The way from values to whole numbers, by float64, is the peer's where it is needed. What a process had
freed before and kept may hide a part of a peak."""

LOSSLESS = """
Every value comes back bit for bit. *Ours* is what a receiver gets until then; the whole file also has metadata and the
index. A dash: the peer cannot, since the values lie on no lattice of 16 bits. What loses here, apart from what the
cells below say: of bijou's float64 values 98 % are float32 numbers, the rest are not, and pcodec finds that out while
our residual does not."""

RESAMPLED = """\
Triangle meshes without rows and columns, resampled into blocks ([remeshing.md](remeshing.md)), beside the best of
Draco over numbers of triangles (quadric decimation by fast-simplification) and of bits, at level 10. Errors are
distances between surfaces, the larger one of both ways, against the input mesh. `for this error` are streams of
`--rms`, `one exact stream` the layers of a stream that was made without naming an error. The meshes are those of
`../shared/data/meshes`: two scans, and a CAD model, for which Draco is the better choice.
"""
