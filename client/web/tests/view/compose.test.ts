import { describe, expect, it } from "vitest";
import { composed, thinned } from "../../src/view/compose";
import type { Grid, Region, SurfaceInfo } from "../../src/view/source";
import { drawingFor } from "../../src/view/windows";

/** Heights over some rows and columns of a surface of 65 x 49 points. */
function part(rows: number[], columns: number[], height: (row: number, column: number) => number, hole = -1): Grid {
  const points = new Float64Array(3 * rows.length * columns.length);
  rows.forEach((row, i) => {
    columns.forEach((column, j) => {
      points.set([column, row, height(row, column)], 3 * (i * columns.length + j));
    });
  });
  const mask = new Uint8Array(rows.length * columns.length).fill(1);
  if (hole >= 0) mask[hole] = 0;
  return {
    rowsAt: Float64Array.from(rows),
    columnsAt: Float64Array.from(columns),
    full: [65, 49],
    closed: [false, false],
    points,
    mask: hole < 0 ? null : mask,
    attributes: [{ name: "a", components: 1, values: Float64Array.from(mask, (_, k) => k) }],
  };
}

const range = (first: number, past: number, step = 1): number[] =>
  Array.from({ length: Math.ceil((past - first) / step) }, (_, k) => first + k * step);

describe("a part in detail inside a coarse grid", () => {
  const coarse = part(range(0, 65, 8), range(0, 49, 8), (row, column) => row + column);

  it("has the part's own values in it, and the coarse grid's around it", () => {
    const fine = part(range(13, 30), range(20, 41), (row, column) => 1000 + row * column);
    const grid = composed(coarse, fine);
    expect([...grid.rowsAt]).toEqual([0, 8, ...range(13, 30), 32, 40, 48, 56, 64]);
    expect([...grid.columnsAt]).toEqual([0, 8, 16, ...range(20, 41), 48]);
    const width = grid.columnsAt.length;
    grid.rowsAt.forEach((row, i) => {
      grid.columnsAt.forEach((column, j) => {
        const node = i * width + j;
        const inside = row >= 13 && row < 30 && column >= 20 && column < 41;
        expect(grid.points[3 * node]).toBeCloseTo(column, 9);
        expect(grid.points[3 * node + 2]).toBeCloseTo(inside ? 1000 + row * column : row + column, 9);
      });
    });
    expect(grid.attributes[0]?.values[2 * width + 3]).toBe(0);
  });

  it("keeps holes of either", () => {
    const grid = composed(
      part(range(0, 65, 8), range(0, 49, 8), () => 0, 0),
      part([10, 11], [10, 11], () => 0, 3),
    );
    const width = grid.columnsAt.length;
    expect(grid.mask![0]).toBe(0);
    expect(grid.mask![width + 2]).toBe(1);
    expect(grid.mask![3 * width + 3]).toBe(0); // row 11, column 11
    expect(grid.points.filter(Number.isNaN)).toHaveLength(3);
  });

  it("is thinned without losing its ends", () => {
    const grid = thinned(
      part(range(3, 14), range(5, 11), (row, column) => 100 * row + column),
      4,
    );
    expect([...grid.rowsAt]).toEqual([3, 7, 11, 13]);
    expect([...grid.columnsAt]).toEqual([5, 9, 10]);
    expect([grid.points[2], grid.points.at(-1)]).toEqual([305, 1310]);
  });
});

describe("what is drawn of a large surface", () => {
  const info: SurfaceInfo = {
    name: "",
    blocks: [{ shape: [8193, 8193], closed: [false, false] }],
    levels: 13,
    extent: 1,
    heights: true,
    georeferenced: false,
    geographic: false,
    mapped: false,
    joined: false,
    unit: "",
    planeUnit: "",
    exact: true,
    attributes: [],
    size: 0,
    prices: null,
  };
  const region: Region = [
    [4000, 4600],
    [100, 700],
  ];

  it("is all of it while it is seen from afar", () => {
    expect(drawingFor(info, 4e6, 9, 13, null, null)).toEqual({ level: 9, window: null });
    expect(drawingFor(info, 4e6, 8, 13, region, null)).toEqual({ level: 8, window: null });
  });

  it("is a level finer than the data, and a part in more detail has data of its own", () => {
    expect(drawingFor(info, 4e6, 13, 8, region, null)).toEqual({ level: 9, window: null });
    expect(drawingFor(info, 4e6, 13, 11, region, null)).toEqual({ level: 11, window: null });
    expect(drawingFor(info, 4e6, 13, 12, region, null).window?.stride).toBe(1);
    expect(drawingFor(info, 4e6, 13, 13, null, null)).toEqual({ level: 11, window: null });
  });

  it("is a part in detail close by, the same one while the view stays in it", () => {
    const { level, window } = drawingFor(info, 4e6, 13, 13, region, null);
    expect(window).toEqual({
      region: [
        [3880, 4720],
        [0, 820],
      ],
      stride: 1,
    });
    expect(level).toBeLessThan(11);
    const near: Region = [
      [3950, 4550],
      [50, 650],
    ];
    expect(drawingFor(info, 4e6, 13, 13, near, window).window).toBe(window);
    const away: Region = [
      [3000, 3600],
      [50, 650],
    ];
    expect(drawingFor(info, 4e6, 13, 13, away, window).window).not.toBe(window);
  });

  it("is thinned where the part is large, and whole where blocks are joined", () => {
    const large: Region = [
      [0, 2500],
      [0, 2500],
    ];
    expect(drawingFor(info, 4e6, 13, 13, large, null).window?.stride).toBe(4);
    expect(drawingFor({ ...info, joined: true }, 4e6, 13, 13, region, null).window).toBeNull();
  });
});
