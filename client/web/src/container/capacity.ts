/**
 * Limits on the memory that decoding a container may take, computed from its header before memory is allocated.
 *
 * A header of a few hundred bytes can announce a surface of billions of points. The numbers are those of the Python
 * library (`lodestream.container.capacity`); what differs is how much there is, since a program in a browser cannot ask.
 */
import { TooLargeError } from "../errors";
import type { Shape } from "../types";

/** What a vertex of a capacity stands for: three coordinates in float64 take somewhat less. */
export const BYTES_PER_VERTEX = 128;

// In any case: headers, metadata, the tables of small surfaces.
const LEAST = 16 * 1024 * 1024;
/** WebAssembly addresses 4 GiB; what is there already and what reconstructions take in between needs room too. */
const DEFAULT_BYTES = 3 * 1024 ** 3;

const [COEFFICIENT, RECONSTRUCTION, MASKS, TABLE] = [7, 16, 4, 2048];
const EDGE = 12; // rows or columns

/** Rows and columns of a grid, and the bytes of a number in each of its channels. */
export interface Extent {
  readonly shape: Shape;
  readonly sizes: readonly number[];
}

/** A memory limit for one container; it counts what has been read. */
export class Capacity {
  /** Bytes allowed for the surface, and again for what is read. */
  readonly bytes: number;
  /** The vertices that were allowed; null: no number was given. */
  readonly maxVertices: number | null;
  #read = 0;

  /** Allows this many vertices and `BYTES_PER_VERTEX` bytes for each, plus 16 MiB; null: 3 GiB. */
  constructor(maxVertices: number | null = null) {
    this.maxVertices = maxVertices;
    this.bytes = maxVertices === null ? DEFAULT_BYTES : LEAST + maxVertices * BYTES_PER_VERTEX;
  }

  /**
   * Refuse a surface that needs more memory than this: so many vertices in these grids, `masked` points for which masks
   * are kept, and `tables` tiles of all channels and blocks. Throws `TooLargeError`.
   */
  promise(vertices: number, grids: Iterable<Extent>, { masked, tables }: { masked: number; tables: number }): void {
    if (this.maxVertices !== null && vertices > this.maxVertices) {
      throw new TooLargeError(`expected at most ${this.maxVertices} vertices (maxVertices), got ${vertices}`);
    }
    let needed = masked * MASKS + tables * TABLE;
    for (const { shape, sizes } of grids) {
      const edges = (1 + EDGE / shape[0]) * (1 + EDGE / shape[1]);
      let each = 0;
      for (const size of sizes) each += RECONSTRUCTION + 2 * size + COEFFICIENT * edges;
      needed += Math.floor(shape[0] * shape[1] * each);
    }
    if (needed > this.bytes) {
      throw new TooLargeError(
        `expected a surface that takes at most ${sizeText(this.bytes)} to decode, ` +
          `got one of ${vertices} vertices that takes ${sizeText(needed)}`,
      );
    }
  }

  /** Count bytes that are read and kept, or that tables take after parsing. Throws `TooLargeError`. */
  take(count: number): void {
    this.#read += count;
    if (this.#read > this.bytes) {
      throw new TooLargeError(`expected a container whose data take at most ${sizeText(this.bytes)}, got more`);
    }
  }
}

function sizeText(count: number): string {
  return `${Math.round(count / 2 ** 20)} MiB`;
}
