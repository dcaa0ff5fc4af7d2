/**
 * What the element needs of a surface that comes into focus: its description, the moments of its arrival, and the grids
 * of any moment. `LodeSource` is one over a stream, HTTP Range or a file; `ArtificialSource` computes one for tests.
 */

/** Rows and columns, half-open, in indices of the full resolution. */
export type Region = readonly [readonly [number, number], readonly [number, number]];

/** How far a surface is asked for; of several limits the first that is met ends the transmission. */
export interface Target {
  /** Levels up to this one and nothing finer; excludes the other limits. */
  level?: number;
  /** An RMS error in the surface's unit. */
  rms?: number;
  /** A maximum error in the surface's unit. */
  max?: number;
  /** The attribute that the error is of, in its own unit; without it the surface. */
  attribute?: string;
  /** Bytes of the surface. */
  bytes?: number;
}

/** One line of the price list: what a layer costs and which error it leaves. */
export interface Price {
  /** Bytes from the beginning of the container. */
  readonly bytes: number;
  /** Finest level with data. */
  readonly level: number;
  readonly rms: number;
  readonly max: number;
}

/** One block of a surface: the lengths of its axes, and whether each is followed by its beginning. */
export interface BlockInfo {
  readonly shape: readonly [number, number];
  readonly closed: readonly [boolean, boolean];
}

/** An array beside the points: its name, and its numbers at a point, at least 1. */
export interface AttributeInfo {
  readonly name: string;
  readonly components: number;
}

/** What is known of a surface before its values. */
export interface SurfaceInfo {
  readonly name: string;
  readonly blocks: readonly BlockInfo[];
  /** Number of the finest level. */
  readonly levels: number;
  /** Range of the heights or diagonal of the bounding box, in the surface's unit. */
  readonly extent: number;
  /** Whether the points are heights over x and y that follow rules. */
  readonly heights: boolean;
  /** Whether x is east and y north. */
  readonly georeferenced: boolean;
  /** Whether x and y are degrees. */
  readonly geographic: boolean;
  /** Whether it has a place on the Earth, so that servers make tiles for maps of it. */
  readonly mapped: boolean;
  /** Whether sides of the blocks are joined, so that all of it has to be drawn at one level. */
  readonly joined: boolean;
  /** Of heights, and of all coordinates where x and y are no other: see `planeUnit`. */
  readonly unit: string;
  /** Of x and y: `°`, a length, or empty where it is not known. */
  readonly planeUnit: string;
  /** Whether the end is exact. */
  readonly exact: boolean;
  readonly attributes: readonly AttributeInfo[];
  /** Bytes of the container. */
  readonly size: number;
  /** The price list, or null while it is not known. */
  readonly prices: readonly Price[] | null;
}

/** An array beside the points of a grid. */
export interface AttributeGrid {
  readonly name: string;
  /** At least 1. */
  readonly components: number;
  /** [row, column, component], in row order; NaN where it has no value. */
  readonly values: Float64Array;
}

/** The points of one block at one level. */
export interface Grid {
  /** Where the rows stand, in indices of the full resolution; rising. */
  readonly rowsAt: Float64Array;
  /** Where the columns stand, likewise. */
  readonly columnsAt: Float64Array;
  /** Lengths of the axes at full resolution. */
  readonly full: readonly [number, number];
  /** Of a map that goes round, the first line follows the last one a turn further, and the axis is not closed. */
  readonly closed: readonly [boolean, boolean];
  /** Full turns of those coordinates that are angles, 0 for others; without it, none is. */
  readonly periods?: readonly [number, number, number];
  /** [row, column, xyz] in the surface's unit. */
  readonly points: Float64Array;
  /** [row, column], 0 at holes; null: there are none. */
  readonly mask: Uint8Array | null;
  readonly attributes: readonly AttributeGrid[];
}

/** A state of the surface on its way, light enough to be kept for ever. */
export interface Moment {
  /** Rises by one from moment to moment. */
  readonly number: number;
  /** Number of the layer that has come last; all before it are there too. */
  readonly layer: number;
  /** The region that the layer has come for, while that comes first; null: it has come for all of the surface. */
  readonly region: Region | null;
  /** Finest level with data. */
  readonly level: number;
  /** Bytes of the surface that are there. */
  readonly bytes: number;
  /** Seconds since the source was opened. */
  readonly seconds: number;
  /** Errors at full resolution in the surface's unit; NaN where they are not known. */
  readonly rms: number;
  readonly max: number;
  /** RMS errors of the attributes in the order of `SurfaceInfo.attributes`, each in its own unit; NaN where not known. */
  readonly attributes: readonly number[];
  /** Whether nothing is missing. */
  readonly complete: boolean;
}

/** The points of all blocks at a moment. */
export interface MomentGrids {
  /** Number of the moment. */
  readonly moment: number;
  readonly grids: readonly Grid[];
}

/** What is known of a node of the full surface. */
export interface NodeValues {
  readonly block: number;
  readonly row: number;
  readonly column: number;
  /** Coordinates in the surface's unit. */
  readonly point: readonly number[];
  /** Names with the values of their components; NaN where there is none. */
  readonly attributes: readonly (readonly [string, readonly number[]])[];
  /** RMS and maximum error of what `within` says, or what they do not exceed; NaN where they are not known. */
  readonly rms: number;
  readonly max: number;
  /** Rows and columns of the part around the node for which the errors hold; null: the whole surface. */
  readonly within: readonly [number, number] | null;
}

/** A part of a surface that is drawn in more detail than the rest. */
export interface DetailWindow {
  readonly region: Region;
  /** Every so many-th row and column of the full resolution. */
  readonly stride: number;
}

/** How the transmission stands. */
export interface Progress {
  readonly state: "connecting" | "receiving" | "waiting" | "resuming" | "stopped" | "target" | "complete" | "failed";
  /** Bytes received, of layers that are not complete too. */
  readonly bytes: number;
  /** Bytes that the target needs; 0 while unknown. */
  readonly planned: number;
  /** Bytes per second lately; 0 while unknown. */
  readonly rate: number;
  /** A sentence where there is something to say: why it failed, when it tries again. */
  readonly detail: string;
  /** A machine's word for a failure, such as `no-token`. */
  readonly code?: string;
  /** Whether what has come is of no use to another attempt, as where the file has changed: it has to begin anew. */
  readonly useless?: boolean;
}

/** What a source tells, as it happens. */
export interface SourceEvents {
  /** The description is there, or has become more complete. */
  info(info: SurfaceInfo): void;
  moment(moment: Moment): void;
  progress(progress: Progress): void;
  /** More is known of the errors at each place: values may be asked for again. */
  refined(): void;
}

/** A surface on its way. Computes nothing on the thread that uses it. */
export interface Source {
  /** Begins; events follow. Called once. */
  start(events: SourceEvents): void;
  /**
   * The grids of all blocks as they were at a moment.
   *
   * @param moment - Number of a moment; null: the latest when it comes to computing them, so that whoever draws more
   * slowly than moments come misses those between.
   * @param level - 0 to `levels`; also one finer than the data of the moment, as if what has not come were 0.
   * @param window - Of the only block, a part that the grid shows in more detail; null: none.
   * @throws Error if they cannot be computed, e.g. because the data are damaged.
   */
  grids(moment: number | null, level: number, window: DetailWindow | null): Promise<MomentGrids>;
  /** The values of a node at full resolution, as they are known at a moment, and the errors that hold there. */
  valuesAt(moment: number, block: number, row: number, column: number): Promise<NodeValues>;
  /** Asks for a region before the rest; null: no longer. Without effect on surfaces of several blocks. */
  focus(region: Region | null): void;
  /** Changes the target; goes on if it had ended. */
  setTarget(target: Target): void;
  /** Ends the transmission: no more bytes are asked for. */
  stop(): void;
  /** Goes on after `stop` or the end of a target. */
  resume(): void;
  /** Bytes per second that are asked for at most; null: as fast as it comes. */
  throttle(rate: number | null): void;
  /** Frees everything; no event follows. */
  close(): void;
}
