/** Blocks of levels: what is received together, and what nobody waits for. */
import { describe, expect, it } from "vitest";
import { BlockCache } from "../../src/maplibre/block-cache";
import { BLOCK, Blocks, type WindowReader } from "../../src/maplibre/blocks";
import type { Region } from "../../src/types";

const SHAPE = [5 * BLOCK + 7, 6 * BLOCK + 1] as const;
const NEVER = new AbortController().signal;

/** The number of a node. */
const at = (row: number, column: number): number => row * 1000 + column;

/** Windows that are asked for, and a reader that gives numbers of nodes. */
function reader(before: (signal: AbortSignal) => Promise<void> = async () => {}) {
  const asked: Region[] = [];
  let busy = 0;
  const read: WindowReader = async (_, window, signal) => {
    asked.push(window);
    busy += 1;
    expect(busy).toBe(1);
    try {
      await before(signal);
    } finally {
      busy -= 1;
    }
    const [[top, bottom], [left, right]] = window;
    const width = right - left;
    return Float32Array.from({ length: (bottom - top) * width }, (_, i) =>
      at(top + Math.floor(i / width), left + (i % width)),
    );
  };
  return { asked, read };
}

function blocksOf(read: WindowReader, bytes = 2 ** 26): Blocks {
  return new Blocks("field", new BlockCache(bytes), () => SHAPE, read);
}

/** All places of a rectangle. */
function rectangle(rows: readonly number[], columns: readonly number[]): [number, number][] {
  return rows.flatMap((row) => columns.map((column): [number, number] => [row, column]));
}

describe("blocks", () => {
  it("that are wanted at once are received as one window, and have the nodes of their places", async () => {
    const { asked, read } = reader();
    const blocks = blocksOf(read);
    const tiles = [rectangle([1, 2], [3, 4]), rectangle([2, 3], [3, 4]), rectangle([1, 2, 3], [5])];
    const found = await Promise.all(tiles.map((places) => blocks.get(3, places, NEVER)));
    expect(asked).toEqual([
      [
        [BLOCK, 4 * BLOCK],
        [3 * BLOCK, 6 * BLOCK],
      ],
    ]);
    tiles.forEach((places, tile) => {
      places.forEach(([row, column], i) => {
        const block = found[tile]![i]!;
        expect(block.length).toBe(BLOCK * BLOCK);
        expect(block[0]).toBe(at(row * BLOCK, column * BLOCK));
        expect(block.at(-1)).toBe(at((row + 1) * BLOCK - 1, (column + 1) * BLOCK - 1));
      });
    });
    await blocks.get(3, rectangle([1, 2, 3], [3, 4, 5]), NEVER);
    expect(asked.length).toBe(1);
    const [corner] = await blocks.get(3, [[5, 6]], NEVER);
    expect(corner!.length).toBe(7);
  });

  it("that nobody wants between those that are wanted are not received, nor those of another level", async () => {
    const { asked, read } = reader();
    const blocks = blocksOf(read);
    await Promise.all([
      blocks.get(3, rectangle([0, 1], [0]), NEVER),
      blocks.get(3, rectangle([1], [1]), NEVER),
      blocks.get(2, rectangle([0], [1]), NEVER),
    ]);
    const cells = asked.reduce((sum, [rows, columns]) => sum + (rows[1] - rows[0]) * (columns[1] - columns[0]), 0);
    expect(cells).toBe(4 * BLOCK * BLOCK);
    expect(asked.length).toBe(3);
  });

  it("are received in windows of a limited size", async () => {
    const { asked, read } = reader();
    const shape = [40 * BLOCK, 40 * BLOCK] as const;
    const blocks = new Blocks("field", new BlockCache(2 ** 26), () => shape, read);
    const line = Array.from({ length: 40 }, (_, i) => i);
    await blocks.get(0, rectangle(line, line), NEVER);
    for (const [rows, columns] of asked) {
      expect((rows[1] - rows[0]) * (columns[1] - columns[0])).toBeLessThanOrEqual(256 * BLOCK * BLOCK);
    }
    expect(asked.length).toBeLessThan(20);
  });

  it("are received again where the cache has no room for them", async () => {
    const { asked, read } = reader();
    const blocks = blocksOf(read, 2 * 4 * BLOCK * BLOCK);
    for (const column of [0, 1, 0, 2, 0, 1]) await blocks.get(0, [[0, column]], NEVER);
    expect(asked.map(([, [left]]) => left / BLOCK)).toEqual([0, 1, 2, 1]);
  });

  it("are not received for those who have left, and what is under way stops when all have", async () => {
    let stopped = 0;
    let come = (): void => {};
    const { asked, read } = reader(
      (signal) =>
        new Promise((resolve, reject) => {
          come = resolve;
          signal.addEventListener("abort", () => {
            stopped += 1;
            reject(signal.reason);
          });
        }),
    );
    const blocks = blocksOf(read);
    const aborts = [0, 1, 2].map(() => new AbortController());
    const [one, other, waits] = [
      blocks.get(1, rectangle([0], [0, 1]), aborts[0]!.signal),
      blocks.get(1, rectangle([0], [1]), aborts[1]!.signal),
      blocks.get(0, rectangle([2], [2]), aborts[2]!.signal),
    ];
    const told = Promise.allSettled([one, other, waits]);
    await expect.poll(() => asked.length).toBe(1);
    aborts[0]!.abort();
    aborts[2]!.abort();
    expect(stopped).toBe(0);
    come();
    await expect(other).resolves.toHaveLength(1);
    expect((await told).map(({ status }) => status)).toEqual(["rejected", "fulfilled", "rejected"]);
    expect(asked.length).toBe(1);
    const last = new AbortController();
    const left = blocks.get(1, rectangle([3], [3]), last.signal);
    await expect.poll(() => asked.length).toBe(2);
    last.abort();
    await expect(left).rejects.toThrow(/abort/i);
    expect(stopped).toBe(1);
    const again = blocks.get(1, rectangle([3], [3]), NEVER); // from the beginning
    await expect.poll(() => asked.length).toBe(3);
    come();
    await expect(again).resolves.toHaveLength(1);
  });

  it("that fail are told to all who wait, and asked for again later", async () => {
    let fails = true;
    const { read } = reader(async () => {
      if (fails) throw new Error("the link is down");
    });
    const blocks = blocksOf(read);
    const told = await Promise.allSettled([blocks.get(0, [[0, 0]], NEVER), blocks.get(0, [[0, 0]], NEVER)]);
    for (const { status } of told) expect(status).toBe("rejected");
    fails = false;
    await expect(blocks.get(0, [[0, 0]], NEVER)).resolves.toHaveLength(1);
  });
});
