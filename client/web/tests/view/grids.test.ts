import { beforeAll, describe, expect, it } from "vitest";
import { Decoder } from "../../src/decoding/decoder";
import { loadKernels } from "../../src/kernels/instance";
import { Geometry } from "../../src/view/geometry";
import { areHeights, attributesIn, gridOf, placeOf } from "../../src/view/grids";
import { containerOf, NAMES } from "../golden";

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

describe.each(NAMES)("the grids of %s", (name) => {
  it("are those of the decoder at every level, and can be drawn", () => {
    const decoder = new Decoder(kernels);
    decoder.feed(containerOf(name));
    const header = decoder.header!;
    const metadata = decoder.metadata ?? {};
    for (let level = 0; level <= header.levels; level += 1) {
      const surface = decoder.surface(level === header.levels ? undefined : level);
      const grids = surface.blocks.map((block, number) => gridOf(block, number, header, metadata));
      grids.forEach((grid, number) => {
        const block = surface.blocks[number]!;
        expect([grid.rowsAt.length, grid.columnsAt.length]).toEqual([...block.shape]);
        for (const [at, length] of [
          [grid.rowsAt, grid.full[0]],
          [grid.columnsAt, grid.full[1]],
        ] as const) {
          expect(at.every((place, k) => place >= 0 && place <= length - 1 && (k === 0 || place > at[k - 1]!))).toBe(
            true,
          );
        }
        const holes = grid.points.filter((value, k) => !Number.isFinite(value) && grid.mask?.[Math.floor(k / 3)] !== 0);
        expect(holes).toHaveLength(0);
        if (areHeights(header)) {
          // Nodes lie where they stand in the finest grid.
          for (const [node, row, column] of [
            [0, grid.rowsAt[0]!, grid.columnsAt[0]!],
            [block.shape[0] * grid.columnsAt.length - 1, grid.rowsAt.at(-1)!, grid.columnsAt.at(-1)!],
          ] as const) {
            if (column >= header.shape[1] || row >= header.shape[0]) continue; // beyond the seam of a map
            expect([...grid.points.subarray(3 * node, 3 * node + 2)]).toEqual(placeOf(metadata, header, row, column));
          }
        }
        expect(grid.attributes.map(({ name, components }) => ({ name, components }))).toEqual(attributesIn(header));
      });
      const geometry = new Geometry();
      const options = { joined: true, geographic: false, heights: true, diagonal: 0, relief: 0, fresh: true };
      const { patches } = geometry.setPicture(grids, options);
      expect(
        patches.every(({ positions, triangles }) => triangles.every((node) => Number.isFinite(positions[3 * node]))),
      ).toBe(true);
    }
    if (!areHeights(header)) return;
    const [block] = decoder.surface().blocks;
    const grid = gridOf(block!, 0, header, metadata);
    for (const [row, column] of [
      [0, 0],
      [header.shape[0] - 1, header.shape[1] - 1],
      [header.shape[0] >> 1, header.shape[1] >> 2],
    ] as const) {
      const node = row * header.shape[1] + column;
      expect([...grid.points.subarray(3 * node, 3 * node + 2)]).toEqual(placeOf(metadata, header, row, column));
    }
  });
});
