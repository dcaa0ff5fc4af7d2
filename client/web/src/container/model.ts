/** Where everything lies in a complete container. */
import type { ByteRange, Chunk, Errors, LayerRecord, LevelRecord, OptionalSection, Segment } from "../types";
import type { Header } from "./header";
import type { Metadata } from "./sections";

interface Parsed {
  readonly header: Header;
  readonly layers: readonly LayerRecord[];
  readonly levelErrors: readonly Errors[];
  readonly segments: readonly Segment[];
  readonly residual: ByteRange | null;
  readonly chunks: readonly Chunk[];
  readonly metadata: ByteRange;
  readonly index: ByteRange;
  readonly size: number;
  readonly optional: readonly OptionalSection[];
}

/** Where everything lies in a complete container. */
export class Index {
  readonly header: Header;
  /** Steps of quality, in file order. */
  readonly layers: readonly LayerRecord[];
  /** The states that hold all of the levels up to one and nothing finer. */
  readonly levels: readonly LevelRecord[];
  /** Layer by layer, in a layer by rising number of the unit: in file order. */
  readonly segments: readonly Segment[];
  /** The residual section; null where the lattice alone is exact, or nothing is stored beyond it. */
  readonly residual: ByteRange | null;
  /** In the order of `chunkPlaces`. */
  readonly chunks: readonly Chunk[];
  /** The section of metadata. */
  readonly metadata: ByteRange;
  /** The pages and the root. */
  readonly index: ByteRange;
  /** Bytes of the file. */
  readonly size: number;
  readonly optional: readonly OptionalSection[];
  /** As far as they are known: an index that was read by itself has none. */
  readonly metadataValues: Metadata;
  /** SHA-256 of the values where all are exact, in hexadecimal digits. */
  readonly digest: string | null;
  readonly #parsed: Parsed;

  constructor(parsed: Parsed, metadataValues: Metadata = {}, digest: string | null = null) {
    this.#parsed = parsed;
    this.header = parsed.header;
    this.layers = parsed.layers;
    this.segments = parsed.segments;
    this.residual = parsed.residual;
    this.chunks = parsed.chunks;
    this.metadata = parsed.metadata;
    this.index = parsed.index;
    this.size = parsed.size;
    this.optional = parsed.optional;
    this.metadataValues = metadataValues;
    this.digest = digest;
    this.levels = this.#levelRecords(parsed.levelErrors);
  }

  /** The length of the prefix that holds header, layers and residual: the complete surface. */
  get surfaceEnd(): number {
    return this.residual ? this.residual.offset + this.residual.length : this.layers.at(-1)!.end;
  }

  /** The same index with metadata. */
  withMetadata(values: Metadata, digest: string | null): Index {
    return new Index(this.#parsed, values, digest);
  }

  /** Each level with what a plan sends for it: header and segments up to the level; for the last the complete stream. */
  #levelRecords(errors: readonly Errors[]): LevelRecord[] {
    const tiles = this.header.layout.tiles;
    const sizes = errors.map(() => 0);
    for (const segment of this.segments) sizes[tiles[segment.tile]!.level]! += segment.range.length;
    let total = this.header.length;
    return errors.map((own, level) => {
      total += sizes[level]!;
      const last = level === this.header.levels;
      const bytes = last ? this.surfaceEnd : total;
      return { level, shape: this.header.levelShape(level), bytes, errors: own };
    });
  }
}
