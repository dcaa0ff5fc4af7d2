/** Blocks of the levels of a container: those that are wanted at once are received together, one window after the other. */

import type { Region, Shape } from "../types";
import type { BlockCache } from "./block-cache";

/** Rows and columns of a block. */
export const BLOCK = 64;

/** Blocks that are received together at most. */
const MOST = 256;

/** Gives a window of a level, (row, column), in metres; NaN in holes. Only one is asked for at a time. */
export type WindowReader = (level: number, window: Region, signal: AbortSignal) => Promise<Float32Array>;

/** A block that is wanted, or is being received. */
interface Wanted {
  readonly level: number;
  readonly row: number;
  readonly column: number;
  /** How many wait for it. */
  waiting: number;
  readonly block: Promise<Float32Array>;
  resolve(block: Float32Array): void;
  reject(reason: unknown): void;
}

/** The blocks of one container. */
export class Blocks {
  private readonly wanted = new Map<string, Wanted>();
  private underWay: { readonly blocks: readonly Wanted[]; readonly abort: AbortController } | undefined;
  private running = false;

  /**
   * @param name Of the container in the cache.
   * @param shapeOf Rows and columns of a level.
   */
  constructor(
    private readonly name: string,
    private readonly cache: BlockCache,
    private readonly shapeOf: (level: number) => Shape,
    private readonly read: WindowReader,
  ) {}

  /**
   * Blocks of a level by their rows and columns, which must not be changed.
   *
   * @throws What the reader throws, or the reason of the signal.
   */
  async get(level: number, places: Iterable<readonly [number, number]>, signal: AbortSignal): Promise<Float32Array[]> {
    signal.throwIfAborted();
    const asked: Wanted[] = [];
    const found = [...places].map(([row, column]) => {
      const kept = this.cache.get(this.key(level, row, column));
      if (kept !== undefined) return kept;
      const wanted = this.want(level, row, column);
      asked.push(wanted);
      return wanted.block;
    });
    const leave = (): void => {
      for (const wanted of asked) this.leave(wanted);
    };
    signal.addEventListener("abort", leave);
    try {
      return await Promise.all(found);
    } finally {
      signal.removeEventListener("abort", leave);
      signal.throwIfAborted();
    }
  }

  private key(level: number, row: number, column: number): string {
    return `${this.name}/${level}/${row}/${column}`;
  }

  private want(level: number, row: number, column: number): Wanted {
    const key = this.key(level, row, column);
    let wanted = this.wanted.get(key);
    if (wanted === undefined) {
      let settle!: Pick<Wanted, "resolve" | "reject">;
      const block = new Promise<Float32Array>((resolve, reject) => {
        settle = { resolve, reject };
      });
      block.catch(() => undefined); // whoever waits is told
      wanted = { level, row, column, waiting: 0, block, ...settle };
      this.wanted.set(key, wanted);
      if (!this.running) void this.run();
    }
    wanted.waiting += 1;
    return wanted;
  }

  private leave(wanted: Wanted): void {
    wanted.waiting -= 1;
    if (wanted.waiting > 0) return;
    wanted.reject(new DOMException("nobody waits for this block any more", "AbortError"));
    const { underWay } = this;
    if (!underWay?.blocks.includes(wanted)) this.wanted.delete(this.key(wanted.level, wanted.row, wanted.column));
    else if (underWay.blocks.every(({ waiting }) => waiting <= 0)) {
      this.drop(underWay.blocks);
      underWay.abort.abort();
    }
  }

  private drop(blocks: readonly Wanted[]): void {
    for (const wanted of blocks) {
      const key = this.key(wanted.level, wanted.row, wanted.column);
      if (this.wanted.get(key) === wanted) this.wanted.delete(key);
    }
  }

  private async run(): Promise<void> {
    this.running = true;
    for (;;) {
      // Messages that ask for the other tiles of a view come meanwhile.
      await new Promise((resolve) => setTimeout(resolve, 0));
      const blocks = this.together();
      if (blocks.length === 0) break;
      this.underWay = { blocks, abort: new AbortController() };
      try {
        await this.receive(blocks, this.underWay.abort.signal);
      } catch (error) {
        for (const { reject } of blocks) reject(error);
      }
      this.drop(blocks);
      this.underWay = undefined;
    }
    this.running = false;
  }

  /** What is wanted longest, and what is wanted around it, as a full rectangle of blocks. */
  private together(): Wanted[] {
    const [first] = this.wanted.values();
    if (first === undefined) return [];
    const { level } = first;
    let [top, left, bottom, right] = [first.row, first.column, first.row + 1, first.column + 1];
    const at = (row: number, column: number) => this.wanted.get(this.key(level, row, column));
    const all = (rows: readonly [number, number], columns: readonly [number, number]): Wanted[] | undefined => {
      const found: Wanted[] = [];
      for (let row = rows[0]; row < rows[1]; row++) {
        for (let column = columns[0]; column < columns[1]; column++) {
          const wanted = at(row, column);
          if (wanted === undefined) return undefined;
          found.push(wanted);
        }
      }
      return found;
    };
    for (let grown = true; grown; ) {
      grown = false;
      const [tall, wide] = [bottom - top, right - left];
      if ((tall + 1) * wide <= MOST && all([bottom, bottom + 1], [left, right])) [bottom, grown] = [bottom + 1, true];
      else if ((tall + 1) * wide <= MOST && all([top - 1, top], [left, right])) [top, grown] = [top - 1, true];
      if ((wide + 1) * (bottom - top) <= MOST && all([top, bottom], [right, right + 1]))
        [right, grown] = [right + 1, true];
      else if ((wide + 1) * (bottom - top) <= MOST && all([top, bottom], [left - 1, left]))
        [left, grown] = [left - 1, true];
    }
    return all([top, bottom], [left, right])!;
  }

  /** Receive a rectangle of blocks, given row by row. */
  private async receive(blocks: readonly Wanted[], signal: AbortSignal): Promise<void> {
    const [first, last] = [blocks[0]!, blocks.at(-1)!];
    const { level } = first;
    const [height, width] = this.shapeOf(level);
    const window: Region = [
      [first.row * BLOCK, Math.min((last.row + 1) * BLOCK, height)],
      [first.column * BLOCK, Math.min((last.column + 1) * BLOCK, width)],
    ];
    const heights = await this.read(level, window, signal);
    const [[top, bottom], [left, right]] = window;
    for (const { row, column, resolve } of blocks) {
      const rows = [row * BLOCK, Math.min((row + 1) * BLOCK, bottom)] as const;
      const columns = [column * BLOCK, Math.min((column + 1) * BLOCK, right)] as const;
      const block = new Float32Array((rows[1] - rows[0]) * (columns[1] - columns[0]));
      for (let at = rows[0]; at < rows[1]; at++) {
        const start = (at - top) * (right - left) - left;
        const part = heights.subarray(start + columns[0], start + columns[1]);
        block.set(part, (at - rows[0]) * (columns[1] - columns[0]));
      }
      this.cache.set(this.key(level, row, column), block);
      resolve(block);
    }
  }
}
