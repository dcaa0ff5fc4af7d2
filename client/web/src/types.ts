/**
 * What container, decoding, transfer and view have in common. Shapes are (rows, columns); indices start at 0; lengths
 * and offsets are bytes; errors and extents are in the surface's own unit.
 */

/** Names of the types of values, by the number that containers have for them. */
export const DTYPES = [
  "int8",
  "int16",
  "int32",
  "int64",
  "uint8",
  "uint16",
  "uint32",
  "uint64",
  "float32",
  "float64",
] as const;

/** Type of a channel's values. */
export type DType = (typeof DTYPES)[number];

/** Bytes of a value of each type. */
export const DTYPE_BYTES: Readonly<Record<DType, number>> = {
  int8: 1,
  int16: 2,
  int32: 4,
  int64: 8,
  uint8: 1,
  uint16: 2,
  uint32: 4,
  uint64: 8,
  float32: 4,
  float64: 8,
};

/** An array of values of one `DType`, in C order. Integers of 64 bits are bigints. */
export type Values =
  | Int8Array
  | Int16Array
  | Int32Array
  | BigInt64Array
  | Uint8Array
  | Uint16Array
  | Uint32Array
  | BigUint64Array
  | Float32Array
  | Float64Array;

/** Rows and columns. */
export type Shape = readonly [rows: number, columns: number];

/** Whether the rows wrap (row H - 1 is followed by row 0), and whether the columns do. */
export type Closed = readonly [rows: boolean, columns: boolean];

/** First and past-the-last index. */
export type Span = readonly [start: number, stop: number];

/** Rows and columns, half-open, in indices of the full resolution. */
export type Region = readonly [rows: Span, columns: Span];

/** Bytes `offset` to `offset + length` of a container. */
export interface ByteRange {
  readonly offset: number;
  readonly length: number;
}

/** RMS and maximum of the distances of a reconstruction from the original. */
export interface Errors {
  readonly rms: number;
  readonly maximum: number;
  /** RMS and maximum of each channel by itself; empty where there is only one channel. */
  readonly channels: ChannelErrors;
}

/** One channel's lattice: affine values are origin + step q, decimal ones (origin + q) / step. */
export interface Lattice {
  readonly rule: "affine" | "decimal";
  readonly origin: number;
  readonly step: number;
}

/** An attribute: an array (rows, columns, components), or (rows, columns) where `components` is 0. */
export interface AttributeKind {
  readonly name: string;
  readonly dtype: DType;
  readonly components: number;
}

/** A step of quality over the whole surface. */
export interface LayerRecord {
  readonly number: number;
  /** Where its section begins, and the length of the container's prefix that ends with it. */
  readonly offset: number;
  readonly end: number;
  /** The finest level with a decoded segment. */
  readonly level: number;
  readonly errors: Errors;
}

/** The state that holds all of the levels up to one and nothing finer. */
export interface LevelRecord {
  readonly level: number;
  /** Rows and columns of the only block's grid; null where there are several blocks. */
  readonly shape: Shape | null;
  /** Bytes that a plan sends for it. */
  readonly bytes: number;
  readonly errors: Errors;
}

/** A run of coding passes that one tile of one channel adds in one layer. */
export interface Segment {
  readonly layer: number;
  readonly tile: number;
  readonly channel: number;
  /** Bit-planes of the tile, 1 to 28; the same for all its segments. */
  readonly top: number;
  readonly passes: number;
  readonly range: ByteRange;
  /** The lower half of the CRC-32 of its bytes. */
  readonly check: number;
}

/** What corrects one channel in one window of a block. */
export interface Chunk {
  readonly range: ByteRange;
  /** The lower half of the CRC-32 of its bytes. */
  readonly check: number;
}

/** A section that a reader may leave alone. */
export interface OptionalSection {
  /** 128 to 255. */
  readonly kind: number;
  readonly range: ByteRange;
}

/** An error in the surface's unit, or relative to its extent (text such as "0.1%"). */
export interface Tolerance {
  readonly value: number;
  readonly relative: boolean;
}

/** RMS and maximum error of each channel by itself. */
export type ChannelErrors = readonly (readonly [rms: number, maximum: number])[];

/** A channel or an attribute by name, which of its errors is meant, and the largest that is allowed, in its unit. */
export type ChannelLimit = readonly [name: string, which: "rms" | "max", most: number];

/** What to receive, where to stop, and in which order; by default the whole surface. See `Target` of the Python library. */
export interface Target {
  /** Levels up to this one and nothing finer; not together with other limits. */
  readonly level?: number;
  /** Stop at the first layer with an error of at most this. */
  readonly untilRms?: Tolerance;
  readonly untilMax?: Tolerance;
  /** Stop at the first layer that meets all of these; not together with errors of the whole surface, or a region. */
  readonly channels?: readonly ChannelLimit[];
  /** Stop at the last layer that ends within so many bytes of the container. */
  readonly maxBytes?: number;
  /** Stop after so much time; the receiver takes care of this. */
  readonly seconds?: number;
  readonly order?: "quality" | "level";
  /** Only this window. */
  readonly region?: Region;
  /** Names of the attributes to include; without it all. */
  readonly attributes?: readonly string[];
  /** What this region needs comes first, then the rest. */
  readonly first?: Region;
}

/** What is known of a state of a surface without decoding it. */
export interface ViewInfo {
  /** Number of the layer, or of the level in level order. The exact end has the next number. */
  readonly number: number;
  /** Finest level of which there are decoded data. */
  readonly level: number;
  /** Bytes received of header, layers and residual. */
  readonly bytes: number;
  /** Errors at full resolution; NaN where they are not known. */
  readonly rms: number;
  readonly maxError: number;
  /** Whether they are bounds, as in a window that is not exact; else they were measured. */
  readonly bound: boolean;
  /** Whether this is the last state. */
  readonly complete: boolean;
  /** Errors of each channel; empty where there is one channel, in a window, and where they are not known. */
  readonly channels: ChannelErrors;
}

/** Values at the points of a block, or the points themselves: an array (rows, columns, components) in C order. */
export interface PointArray {
  readonly dtype: DType;
  /** Numbers at a point. */
  readonly components: number;
  /** The array came without an axis of components, which are 1: heights, or a scalar attribute. */
  readonly flat: boolean;
  readonly values: Values;
}

/** One structured grid of points, at some level or in a window. */
export interface Block {
  readonly shape: Shape;
  readonly closed: Closed;
  /** Heights (1 component), x, y (2), x, y, z (3), or x, y, z and attributes (more). */
  readonly points: PointArray;
  /** (rows, columns), 1 where a point is valid, 0 in holes; null: all points are valid. */
  readonly mask: Uint8Array | null;
  readonly attributes: ReadonlyMap<string, PointArray>;
  /** Which rows and columns of the full grid these are, increasing. */
  readonly rows: Int32Array;
  readonly columns: Int32Array;
}

/** A state of a surface: its blocks, and its metadata as far as they have arrived. */
export interface Surface {
  readonly blocks: readonly Block[];
  readonly metadata: Readonly<Record<string, unknown>>;
}
