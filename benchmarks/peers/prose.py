"""The words of ``docs/benchmarks.md`` that do not depend on what was measured."""

from __future__ import annotations

__all__ = ["GATES", "LINKS", "LOSSLESS", "MEMORY", "NOT_MEASURED", "RESAMPLED", "RULES", "SECONDS", "SPEED"]

RULES = """\
- Names that begin with `shared` are files of a folder beside the clone, which is not part of this project.
- A cell is one error on one surface. Errors are relative to the range of heights; for x, y, z they are distances in
  space, relative to the diagonal of the bounding box. They are measured on the decoded values, for Lodestream (*ours*)
  and for the other coders (*peers*) alike.
- Each peer is used with the best of its settings and modes. Each cell is compared with its best peer.
- There are two figures for Lodestream. *One exact stream* is made once, without a given error, and stopped where its
  error is small enough: the use that Lodestream is made for. *At its best setting* is the best of that stream and of
  streams made for one error, as the peers' are. Their settings: `rms` is the stream for that RMS error (`lodestream
  encode --rms`); `precision` is sqrt(3) times the RMS error, or the maximum error itself (for heights of integer type
  the step is an odd integer); `each error` is interpolated between the ends of such streams, as a peer's settings are.
  The aims are for the best setting, since the peers have theirs.
- Bytes are interpolated between settings, or between the layers of one stream, in log-log on the lower envelope. Below
  the smallest error of a lossy stream the lossless stream counts. If a peer's stream lacks the shape, the type and the
  mapping of its integers to values, 32 bytes are added.
- Peers that code planes get x, y and z one after another, with the same absolute error in each. Integer coders get the
  lattice of the values if there is one and, for larger errors, values quantised with the step that just meets the
  error. Floating-point coders get float32, and for lossless the type of the data.
- Surfaces of more than four million samples are tried at fewer settings, with all coders.
- A ratio below 1 means that Lodestream needs fewer bytes; **bold** means that it needs more. Means are geometric, over
  cells where the best peer needs 4 KB or more."""

SECONDS = """\
The time until a receiver has points with a given RMS error, or every value: transfer and decoding, on one core. The
link is calculated, not emulated: no handshake, no round trip, no loss.

- *Ours* is the one exact stream, made without a given error and decoded as it arrives. A layer is decoded once it has
  arrived and the layers before it are decoded; segments are prepared when 8 KiB of them wait (`View.prepare`). At the
  first layer that meets the error the points are computed, once. So the time after the last byte is that of this
  layer, of the waiting segments and of the points.
- *A peer* sends the stream that meets the error, which is decoded when it is complete. Each coder has all its settings,
  and interpolations between two of them; each cell takes the best of all coders. For integer coders the conversion of
  integers to values is not counted; ours gives values.
- Decoding is processor time, the least of several runs, since the machine may be shared.
- A ratio below 1 means that Lodestream is faster. Means are geometric, over all cells. **Bold**: a mean or a worst cell
  that misses its aim, or a cell above 1.
- `by the script`: the mean by the rules of `shared/bench/time_to_error.py`, which has fewer peers, no interpolation
  between their settings, and counts all our decoding as if it happened while bytes arrive. The aims are for the
  stricter figure before it."""

LINKS = """\
Wall-clock seconds from the connection to the points, over links that a proxy emulates: a bit rate towards the client,
half the round trip in each direction, no TCP handshake and no slow start. These figures are measured, not calculated.

- *Ours* comes from `lodestream serve` over WebSocket to the Python client: one exact stream in the server's default
  form, stopped at the error.
- A peer's file is its smallest that meets the error. Python's own server sends it over HTTP, and the same process
  decodes it when it is complete. Its coder needs to know the error beforehand; ours is one stream for all errors.
- `raw`: the bytes of the array over HTTP, exact at every error.
- Server, proxy and client share the machine. So the fastest links do not reach their speed, and other work on the
  machine counts. `of processors`: processor time of the client's process.
- At 1 Mbit/s each figure is of one run, otherwise the median of three, in alternation."""

NOT_MEASURED = """\
- **Intra frames of AV1, HEVC and VVC** at 10 to 12 bits: they need 0.7 to 1.2 of our bytes at an RMS error of 1e-2 of
  terrain. Their streams have one error; they cannot be refined.
- **HPEZ**: for some maximum errors it needs 0.8 to 0.9 of the bytes of the best other coder, and cannot be refined
  either.

These two figures are not from this program, since no package provides these coders."""

GATES = """\
Means, worst ratios and aims are of cells of 4 KB or more; aims are for the best setting. Bold means: above the aim, or
above 1 where there is no aim (means), or above 1 (worst). No cell should be above 1.03, and none below 4 KB more than
600 bytes above the peer."""

SPEED = """
MB count the samples as float32, whatever their type. Geometric means over the surfaces, without the tiny ones, on one
core. *At 1e-4*: the setting with the nearest RMS error, if that is within a factor of 3; for streams of layers or
prefixes, encoding is that of the whole stream. Ours is the exact stream: encoding measures the errors of every layer
and level, decoding at 1e-4 is that of a prefix. Times are processor times, the best of three if they are short,
otherwise of one run, without the conversion of integers to values. A coder is measured again only if it has changed,
possibly at another hour; other work on the machine slows processors down too."""

MEMORY = """
Peak memory above that of the process with the surface loaded: the largest over the settings, as a multiple of the
samples as float32. It includes the conversion of values to integers, by float64, where a peer needs it. Memory that a
process had freed and kept before may hide a part of a peak."""

LOSSLESS = """
Every value is restored bit for bit. *Ours* is the bytes that a receiver gets until then; the whole file also has
metadata and the index. A dash: the peer cannot code these values, since they lie on no lattice of 16 bits. One loss is
not explained below: of bijou's float64 values 98 % are float32 numbers. pcodec makes use of this, our residual does
not."""

RESAMPLED = """\
Triangle meshes without rows and columns, resampled into blocks ([remeshing.md](remeshing.md)), beside the shortest file
of Draco that reaches the error: for each number of bits, the fewest triangles (quadric decimation by
fast-simplification) are looked for to within 4 %, at level 10. Bytes of Lodestream are interpolated between streams.
Errors are distances between surfaces, the larger one of both ways, against the input mesh. `for this error` are streams
of `--rms`, `one exact stream` the layers of a stream that was made without naming an error. The meshes are those of
`shared/data/meshes`: two scans, and a CAD model, for which Draco is the better choice.
"""
