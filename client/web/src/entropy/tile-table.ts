/**
 * Where all bands of a channel's tiles stand in the flat arrays that kernels work on, zeros around each band
 * (core/kernels/band_fields.h).
 */
import type { Band, Layout } from "../grid/layout";
import type { Address, Arena } from "../kernels/arena";

/** Numbers that describe a band: its place, stride, rows, columns, flags, parent, parent's stride, shifts, kind. */
const BAND_FIELDS = 10;
/** What a kernel may look at behind the last coefficient and its margin. */
const PADDING = 16;
/** A band without a parent finds a zero between zeros, to which 31 shifts any row or column. */
const NO_PARENT = [1, 0, 31, 31] as const;

interface Placed {
  readonly band: Band;
  readonly place: number;
  readonly stride: number;
}

/** Places of all bands of all tiles, in an arena. */
export class TileTable {
  readonly layout: Layout;
  /** The bands of each tile. */
  readonly members: readonly (readonly Band[])[];
  /** Number of each tile's first band, and the number of bands at the end. */
  readonly first: Int32Array;
  /** Lengths of the flat arrays of coefficients and of block flags. */
  readonly size: number;
  readonly blocks: number;
  /** Numbers of the bands of each grid, coarsest level first. */
  readonly ofGrid: readonly (readonly number[])[];
  /** Of each band its tile. */
  readonly tileOf: Int32Array;
  /** The table of bands for kernels, and how many numbers it has. */
  readonly bands: Address;
  readonly bandsCount: number;
  /** Of each band its tile, and its first row and column among all coefficients. */
  readonly windows: Address;

  /** Lay out the tiles of a surface, for its coordinates or for other channels, which take nothing from interfaces. */
  constructor(arena: Arena, layout: Layout, coordinate: boolean) {
    this.layout = layout;
    this.members = layout.tiles.map((tile) => (coordinate ? tile.bands : tile.whole));
    const rows: number[] = [];
    const windows: number[] = [];
    const ofGrid: number[][] = layout.grids.map(() => []);
    const first = new Int32Array(layout.tiles.length + 1);
    const known: Map<number, Placed>[] = []; // of every tile so far; parents come before their children
    let [size, blocks, count] = [3, 0, 0];
    for (const [number, tile] of layout.tiles.entries()) {
      const above = known[tile.parent];
      const own = new Map<number, Placed>();
      for (const band of this.members[number]!) {
        ofGrid[band.grid]!.push(count++);
        const height = band.rows[1] - band.rows[0];
        const width = band.columns[1] - band.columns[0];
        const stride = width + 2;
        const across = (width + 7) >> 3;
        const place = size + 2 * stride + 2;
        const kind = 2 * Number(band.kind[0]) + Number(band.kind[1]);
        own.set(4 * band.grid + kind, { band, place, stride });
        const parent = above?.get(4 * band.grid + kind);
        const joined = parent ? joinedTo(parent, band, tile.level, layout) : NO_PARENT;
        rows.push(place, stride, height, width, blocks + across + 2, ...joined, kind);
        windows.push(number, band.rows[0], band.columns[0]);
        size += (height + 4) * stride + 2;
        blocks += (((height + 7) >> 3) + 2) * (across + 1) + 1;
      }
      first[number + 1] = count;
      known.push(own);
    }
    this.first = first;
    this.size = size + PADDING;
    this.blocks = blocks;
    this.ofGrid = ofGrid;
    this.tileOf = Int32Array.from({ length: count }, (_, band) => windows[3 * band]!);
    this.bandsCount = count * BAND_FIELDS;
    this.bands = arena.putI64(rows);
    this.windows = arena.putI64(windows);
  }
}

/** What a band of this level says of its parent: where the parent of its first coefficient stands, and how to go on. */
function joinedTo(parent: Placed, band: Band, level: number, layout: Layout): readonly number[] {
  const finer = layout.shape(band.grid, level - 1);
  const coarser = layout.shape(band.grid, level - 2);
  const down = Number(finer[0] !== coarser[0]);
  const right = Number(finer[1] !== coarser[1]);
  // Without its first row, which comes from an interface, a band has an odd origin: its parent's has one too.
  const row = ((band.origin[0] + down) >> down) - parent.band.origin[0];
  const column = ((band.origin[1] + right) >> right) - parent.band.origin[1];
  return [parent.place + row * parent.stride + column, parent.stride, down, right];
}
