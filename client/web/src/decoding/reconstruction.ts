/** Segments into points: the state of a surface that is being refined, and values of any state that it passed. */

import { type ChunkPlace, chunkPlaces } from "../container/chunks";
import type { Header } from "../container/header";
import { type BlockMasks, decodeKept, decodeMasks } from "../entropy/mask";
import { TileTable } from "../entropy/tile-table";
import { type Plane, Tiles } from "../entropy/tiles";
import { patchesByBlock } from "../grid/patches";
import { hullOf, meets } from "../grid/window";
import { Arena } from "../kernels/arena";
import { accepted } from "../kernels/instance";
import { platformSha256, sha256 } from "../kernels/sha256";
import { regionAt, restoredRegion } from "../planning/selection";
import { decodeChunk } from "../residual/chunk-coder";
import { allocatePlane, FRACTION_BITS, inverse } from "../transform/pyramid";
import { DTYPE_BYTES, DTYPES, type DType, type Region } from "../types";
import { reconstructWindow } from "./crop";
import { assemble, clearGrid, cutGrid, type Grid, newGrid, putPoints, takePoints } from "./grids";

/** A segment with its bytes: `passes` passes of a unit down from `first`. */
export interface Coded {
  readonly tile: number;
  readonly channel: number;
  readonly first: number;
  readonly passes: number;
  readonly data: Uint8Array;
}

/** Lattice coordinates of grids over two to the power of `fraction`. */
export interface Reconstructed {
  readonly planes: readonly Plane[];
  readonly fraction: number;
}

/** What a view is made of: how many segments are known, and the passes that remain of each unit. */
export interface Known {
  readonly length: number;
  readonly state: Int8Array;
}

/** A block's points, and its attributes, in order. */
export type BlockGrids = readonly Grid[];

/** Segments in one call of the kernels. */
const BATCH = 256;

/**
 * Decodes segments when values are asked for, in the order in which they were added.
 *
 * States that lie behind what was decoded can be reconstructed too: what later passes told is ignored.
 */
export class Reconstruction {
  readonly header: Header;
  readonly #arena: Arena;
  readonly #chunks = new Map<number, { data: Uint8Array; offset: number }>();
  #queue: Coded[] = [];
  #added = 0;
  #tiles: Tiles[] | null = null;
  #masks: BlockMasks | null = null;
  #kept: BlockMasks | null = null;

  constructor(module: WebAssembly.Module, header: Header) {
    this.#arena = new Arena(module);
    this.header = header;
  }

  /** Segments added so far. */
  get length(): number {
    return this.#added;
  }

  /** For each block which points are valid. */
  get masks(): BlockMasks {
    this.#masks ??= decodeMasks(this.#arena, this.header);
    return this.#masks;
  }

  /** For each block which holes have values that come back. */
  get kept(): BlockMasks {
    this.#kept ??= decodeKept(this.#arena, this.header, this.masks);
    return this.#kept;
  }

  /** Take a segment; nothing is decoded yet. */
  add(segment: Coded): void {
    this.#queue.push(segment);
    this.#added++;
  }

  /** Take a chunk of the residual section, which stands at `offset`. */
  correct(number: number, data: Uint8Array, offset: number): void {
    if (data.length) this.#chunks.set(number, { data, offset });
  }

  /**
   * The grids of `level`, one for each block, exact where `corrected`. Channels that are not `chosen` mean nothing.
   * Throws `CorruptStreamError` where a chunk of the residual section does not fit.
   */
  blocks(known: Known, level: number, corrected: boolean, chosen: readonly boolean[]): BlockGrids[] {
    const blocks = this.#whole(known, level, chosen);
    if (corrected) this.#correct(blocks, chosen);
    return blocks;
  }

  /**
   * The points of a level in a region of the surface, of one grid. Takes memory for what the window is made of, not for
   * the surface; but an axis along which it crosses the seam is made whole.
   */
  window(known: Known, region: Region, level: number, corrected: boolean, chosen: readonly boolean[]): BlockGrids {
    const shape = this.header.layout.shape(0, level);
    const around = restoredRegion(this.header, region, level);
    const hull = hullOf(around, shape);
    const first = [hull[0][0], hull[1][0]] as const;
    const grids = this.#window(known, hull, level, chosen);
    if (corrected) this.#correct([grids], chosen, around, first);
    return grids.map((grid) => cutGrid(grid, regionAt(this.header, region, level), shape, first));
  }

  /** Give points of a block where `shown` is 0 the values of holes. */
  clear(grids: BlockGrids, shown: Uint8Array): void {
    for (const [number, grid] of grids.entries()) clearGrid(grid, shown, number ? 0n : this.header.masks.hole);
  }

  /** The SHA-256 of values one after another, in hexadecimal digits. */
  digest(bytes: readonly Uint8Array[]): string {
    return sha256(this.#arena, bytes);
  }

  /** The same, by the platform where it has it. */
  async digestAsync(bytes: readonly Uint8Array<ArrayBuffer>[]): Promise<string> {
    return (await platformSha256(bytes)) ?? this.digest(bytes);
  }

  /** The values of all blocks before residual and holes. */
  #whole(known: Known, level: number, chosen: readonly boolean[]): BlockGrids[] {
    const { header } = this;
    const { layout, patches } = header;
    const tiles = this.#decoded(known.length);
    const interfaces = layout.grids.length - patches.length;
    const own = patchesByBlock(patches, header.blocks.length);
    const found: Grid[][] = header.blocks.map(() => []);
    this.#eachArray((dtype, count, first) => {
      const grids = this.#arena.scope(() => {
        const made = patches.map((_, patch) => {
          const [rows, columns] = layout.shape(interfaces + patch, level);
          return { rows, columns, points: this.#arena.zeros(rows * columns * count * DTYPE_BYTES[dtype]) };
        });
        for (let component = 0; component < count; component++) {
          const channel = first + component;
          if (!chosen[channel]) continue;
          this.#arena.scope(() => {
            const reconstructed = this.#reconstruct(tiles[channel]!, channel, known.state, level);
            for (const [patch, { points }] of made.entries()) {
              const plane = reconstructed.planes[interfaces + patch]!;
              this.#store(channel, plane, reconstructed.fraction, points, dtype, count, component);
            }
          });
        }
        return made.map(({ rows, columns, points }): Grid => {
          const values = this.#arena.values(dtype, points, rows * columns * count).slice();
          return { dtype, shape: [rows, columns], components: count, values };
        });
      });
      for (const [block, { shape }] of header.blocks.entries()) {
        found[block]!.push(assemble(header, own[block]!, level, shape, grids));
      }
    });
    return found;
  }

  /** The values of a window of a level before residual and holes; `region` has rows and columns of the level. */
  #window(known: Known, region: Region, level: number, chosen: readonly boolean[]): Grid[] {
    const tiles = this.#decoded(known.length);
    const shape = [region[0][1] - region[0][0], region[1][1] - region[1][0]] as const;
    const found: Grid[] = [];
    this.#eachArray((dtype, count, first) => {
      const grid = newGrid(dtype, shape, count);
      if (Array.from({ length: count }, (_, k) => chosen[first + k]).some(Boolean)) {
        this.#arena.scope(() => {
          const points = this.#arena.zeros(grid.values.byteLength);
          for (let component = 0; component < count; component++) {
            const channel = first + component;
            const state = this.#stateOf(channel, known.state);
            this.#arena.scope(() => {
              const reconstructed = reconstructWindow(
                this.#arena,
                this.header,
                channel,
                tiles[channel]!,
                state,
                region,
                level,
              );
              this.#store(channel, reconstructed.plane, reconstructed.fraction, points, dtype, count, component);
            });
          }
          const bytes = new Uint8Array(grid.values.buffer);
          bytes.set(this.#arena.u8(points, bytes.length));
        });
      }
      found.push(grid);
    });
    return found;
  }

  /** Do something for the points and each attribute: their type, components, and first channel. */
  #eachArray(work: (dtype: DType, components: number, first: number) => void): void {
    const { header } = this;
    work(header.dtype, header.pointChannels, 0);
    let first = header.pointChannels;
    for (const kind of header.attributes) {
      const count = Math.max(kind.components, 1);
      work(kind.dtype, count, first);
      first += count;
    }
  }

  /** Values of lattice coordinates into one component of points. */
  #store(
    channel: number,
    plane: Plane,
    fraction: number,
    points: number,
    dtype: DType,
    components: number,
    component: number,
  ): void {
    const { rule, origin, step } = this.header.lattices[channel]!;
    const { address, rows, columns, pitch } = plane;
    const result = this.#arena.kernels.store_values(
      address,
      rows,
      columns,
      pitch,
      points,
      DTYPES.indexOf(dtype),
      components,
      component,
      Number(rule === "decimal"),
      origin,
      step,
      2 ** -fraction,
    );
    accepted(result, "store_values");
  }

  /** One channel of the grids of a level; in memory that the caller's scope ends. */
  #reconstruct(tiles: Tiles, channel: number, every: Int8Array, level: number): Reconstructed {
    const { layout, predictors, geometric } = this.header;
    const state = this.#stateOf(channel, every);
    let whole = 0;
    while (whole < level && !state.subarray(...layout.tilesOf(whole + 1)).some((left) => left !== 0)) whole++;
    const planes = layout.grids.map((_, grid) => allocatePlane(this.#arena, layout.shape(grid, level)));
    tiles.dequantizeLevels(level, state, planes, whole);
    inverse(this.#arena, planes, layout, predictors[channel]!, level, whole, channel < geometric);
    return { planes, fraction: whole < level ? FRACTION_BITS : 0 };
  }

  /** The passes that remain of each tile of a channel. */
  #stateOf(channel: number, every: Int8Array): Int8Array {
    const { channels, layout } = this.header;
    return Int8Array.from({ length: layout.tiles.length }, (_, tile) => every[tile * channels + channel]!);
  }

  /**
   * Restore all windows of the residual that there are, or of a region of the only block those inside. The grids begin
   * at row and column `first` of the block.
   */
  #correct(
    blocks: readonly BlockGrids[],
    chosen: readonly boolean[],
    region: Region | null = null,
    first: readonly [number, number] = [0, 0],
  ): void {
    const { shape } = this.header.blocks[0]!;
    let number = -1;
    for (const window of chunkPlaces(this.header)) {
      const chunk = this.#chunks.get(++number);
      if (!chunk || !chosen[window.channel]) continue;
      if (region && !meets(region[0], window.rows, shape[0])) continue;
      if (region && !meets(region[1], window.columns, shape[1])) continue;
      let component = window.channel;
      const grids = blocks[window.block]!;
      const grid = grids.find((one) => {
        const own = component < one.components;
        if (!own) component -= one.components;
        return own;
      })!;
      const points = this.#pointsOf(window, grid, first);
      const restored = takePoints(grid, component, points);
      const values = decodeChunk(this.#arena, restored, grid.dtype, chunk.data, chunk.offset);
      putPoints(grid, component, points, values);
    }
  }

  /** The points of a grid that a chunk restores; the grid begins at a row and column of the block. */
  #pointsOf(window: ChunkPlace, grid: Grid, [top, left]: readonly [number, number]): Int32Array {
    const { rows, columns, block } = window;
    const mask = (window.kept ? this.kept : this.masks)[block];
    const width = this.header.blocks[block]!.shape[1];
    const points = new Int32Array((rows[1] - rows[0]) * (columns[1] - columns[0]));
    let count = 0;
    for (let row = rows[0]; row < rows[1]; row++) {
      for (let column = columns[0]; column < columns[1]; column++) {
        if (!mask || mask[row * width + column]) points[count++] = (row - top) * grid.shape[1] + (column - left);
      }
    }
    return points.subarray(0, count);
  }

  /** The tiles of each channel once so many segments are decoded. */
  #decoded(length: number): Tiles[] {
    const { header } = this;
    if (this.#tiles === null) {
      const { layout } = header;
      const table = new TileTable(this.#arena, layout, true);
      const other = layout.shared ? new TileTable(this.#arena, layout, false) : table;
      this.#tiles = header.lattices.map((_, channel) => {
        const coordinate = channel < header.geometric;
        return new Tiles(this.#arena, coordinate ? table : other, coordinate ? header.base : 0, header.large);
      });
    }
    const waiting = length - (this.#added - this.#queue.length);
    for (let start = 0; start < waiting; start += BATCH) {
      const batch = this.#queue.slice(start, Math.min(start + BATCH, waiting));
      for (const [channel, tiles] of this.#tiles.entries()) {
        const runs = batch.filter((segment) => segment.channel === channel);
        if (runs.length) {
          tiles.read(runs.map(({ tile, first, passes, data }) => ({ tile, first, last: first - passes + 1, data })));
        }
      }
    }
    if (waiting > 0) this.#queue = this.#queue.slice(waiting);
    return this.#tiles;
  }
}
