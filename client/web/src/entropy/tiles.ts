/** The coefficients of one channel as far as they are decoded, and their coder (docs/format.md, section 7). */
import type { Address, Arena } from "../kernels/arena";
import { accepted } from "../kernels/instance";
import { bandSteps } from "../quantization/band-steps";
import type { TileTable } from "./tile-table";

/** Passes that remain of a tile that was not announced: more than any tile has. */
export const UNANNOUNCED = 57;
/** Contexts of a unit, and of one of indices of a trellis; what a context is at the start. */
const [MODEL, TRELLIS_MODEL, NEW_CONTEXT] = [79, 155, (1 << 27) | 1];
const RUN_FIELDS = 8;
const PASSES_STATE = 8;
/** Coefficients that are looked at in one call of the kernel. */
const AT_ONCE = 1 << 26;

/** A run of passes of a tile, from the pass `first` down to `last`, with its bytes. */
export interface Run {
  readonly tile: number;
  readonly first: number;
  readonly last: number;
  readonly data: Uint8Array;
}

/** A plane of numbers in an arena: `pitch` elements from one row to the next. */
export interface Plane {
  readonly address: Address;
  readonly rows: number;
  readonly columns: number;
  readonly pitch: number;
}

/** Magnitudes, signs, block flags, marks of first passes and models of one channel. */
export class Tiles {
  readonly table: TileTable;
  readonly #arena: Arena;
  readonly #trellis: boolean;
  readonly #large: number; // the first tile that is a large unit
  readonly #known: Address;
  readonly #sign: Address;
  readonly #early: Address;
  readonly #flags: Address;
  readonly #models: Address;
  readonly #modelsCount: number;
  readonly #steps: Address;

  /** `base` is that of the quantiser, 0 where there is none; `large` the coarsest level of large units, or 0. */
  constructor(arena: Arena, table: TileTable, base: number, large: number) {
    const { size, blocks, layout } = table;
    const tiles = layout.tiles.length;
    this.#arena = arena;
    this.table = table;
    this.#trellis = base > 0;
    this.#large = this.#trellis ? tiles : layout.tilesFrom(large);
    this.#known = arena.zeros(4 * size);
    this.#sign = arena.zeros(size);
    this.#early = arena.zeros(size);
    this.#flags = arena.zeros(blocks);
    const model = this.#trellis ? TRELLIS_MODEL : MODEL;
    this.#modelsCount = tiles * model;
    this.#models = arena.zeros(4 * this.#modelsCount);
    arena.i32(this.#models, this.#large * model).fill(NEW_CONTEXT);
    const bands = table.tileOf.length;
    this.#steps = arena.putI64(base ? bandSteps(table, base) : new Int32Array(bands));
  }

  /** Decode runs of passes one after another. */
  read(runs: readonly Run[]): void {
    const { table } = this;
    const fields: number[] = [];
    let length = 0;
    for (const { tile, first, last, data } of runs) {
      const band = table.first[tile]!;
      const bands = table.first[tile + 1]! - band;
      fields.push(band, bands, tile, first, last, length, data.length, Number(tile >= this.#large));
      length += data.length;
    }
    const arena = this.#arena;
    arena.scope(() => {
      const described = arena.putI64(fields);
      const state = arena.zeros(8 * PASSES_STATE);
      const bytes = arena.take(length);
      const view = arena.u8(bytes, length);
      let place = 0;
      for (const { data } of runs) {
        view.set(data, place);
        place += data.length;
      }
      let done = 0;
      while (done < runs.length) {
        const result = arena.kernels.passes(
          Number(this.#trellis),
          table.bands,
          table.bandsCount,
          described,
          RUN_FIELDS * runs.length,
          this.#known,
          this.#sign,
          this.#early,
          table.size,
          this.#flags,
          table.blocks,
          this.#models,
          this.#modelsCount,
          bytes,
          length,
          state,
          AT_ONCE,
        );
        done = accepted(result, "passes");
      }
    });
  }

  /**
   * Put some bands into a plane of coefficients, which begins at a row and column of all coefficients. Unknown bits are
   * replaced by the reconstruction point; what the passes that remain told counts as unknown.
   *
   * `state` has the passes that remain of each tile; coefficients of the tiles from `finer` on are multiplied by 8.
   */
  dequantize(numbers: ArrayLike<number>, state: Int8Array, finer: number, out: Plane, row = 0, column = 0): void {
    const arena = this.#arena;
    const { table } = this;
    arena.scope(() => {
      const chosen = arena.putI64(numbers);
      const remaining = arena.put(new Uint8Array(state.buffer, state.byteOffset, state.length));
      const result = arena.kernels.dequantize(
        this.#known,
        this.#sign,
        this.#early,
        table.size,
        table.bands,
        table.bandsCount,
        table.windows,
        this.#steps,
        chosen,
        numbers.length,
        remaining,
        state.length,
        finer,
        out.address,
        out.rows,
        out.columns,
        out.pitch,
        row,
        column,
      );
      accepted(result, "dequantize");
    });
  }

  /** `dequantize` all tiles of the levels up to one into planes of the grids; those above `whole` multiplied by 8. */
  dequantizeLevels(level: number, state: Int8Array, planes: readonly Plane[], whole: number): void {
    const { table } = this;
    const last = table.first[table.layout.tilesOf(level)[1]]!;
    const finer = table.layout.tilesOf(whole)[1];
    for (const [grid, plane] of planes.entries()) {
      const chosen = table.ofGrid[grid]!.filter((band) => band < last && state[table.tileOf[band]!]! < UNANNOUNCED);
      if (chosen.length) this.dequantize(chosen, state, finer, plane);
    }
  }
}
