import { describe, expect, it } from "vitest";
import { Geometry } from "../../src/view/geometry";
import { unrolled } from "../../src/view/maps";
import type { Grid } from "../../src/view/source";

const ramp = (n: number): Float64Array => Float64Array.from({ length: n }, (_, k) => k);

/** A grid closed along its columns, with points [row, column]. */
function closedGrid(rows: number, columns: number, point: (row: number, column: number) => number[]): Grid {
  const points = new Float64Array(3 * rows * columns);
  for (let i = 0; i < rows; i += 1) {
    for (let j = 0; j < columns; j += 1) points.set(point(i, j), 3 * (i * columns + j));
  }
  return {
    rowsAt: ramp(rows),
    columnsAt: ramp(columns),
    full: [rows, columns],
    closed: [false, true],
    points,
    mask: null,
    attributes: [{ name: "twice", components: 1, values: ramp(rows * columns).map((value) => 2 * value) }],
  };
}

const xOf = ({ points, columnsAt }: Grid, row = 0): number[] =>
  Array.from(columnsAt, (_, j) => points[3 * (row * columnsAt.length + j)]!);

/** The longest edge along x of all triangles, in the surface's coordinates. */
function longest(grid: Grid): number {
  const geometry = new Geometry();
  const options = { joined: false, geographic: false, heights: true, diagonal: 0, relief: 0, fresh: true };
  const { patches } = geometry.setPicture([grid], options);
  let most = 0;
  for (const { positions, triangles } of patches) {
    for (let t = 0; t < triangles.length; t += 3) {
      const x = [0, 1, 2].map((k) => positions[3 * triangles[t + k]!]!);
      most = Math.max(most, (Math.max(...x) - Math.min(...x)) / geometry.frame.scale[0]);
    }
  }
  return most;
}

describe("closed axes", () => {
  const map = closedGrid(5, 36, (i, j) => [5 + 10 * j, i, Math.cos(j)]);
  const angles = { angles: [{ channel: 0, period: 360, low: -180 }] };

  it("of a height field end a turn further, and no quad leads back", () => {
    const grid = unrolled(map, true, {});
    expect(grid.closed).toEqual([false, false]);
    expect(xOf(grid, 3)).toEqual(Array.from({ length: 37 }, (_, j) => 5 + 10 * j));
    expect(grid.columnsAt.at(-1)).toBe(36);
    expect(grid.points[3 * 36 + 2]).toBe(map.points[2]);
    expect(grid.attributes[0]!.values[36]).toBe(0);
    expect(longest(map)).toBeCloseTo(350, 3);
    expect(longest(grid)).toBeCloseTo(10, 3);
  });

  it("of a coarse level end where those of the finest do", () => {
    const coarse = { ...closedGrid(5, 4, (i, j) => [5 + 90 * j, i, 0]), columnsAt: Float64Array.of(0, 9, 18, 27) };
    const grid = unrolled({ ...coarse, full: [5, 36] }, true, {});
    expect(xOf(grid)).toEqual([5, 95, 185, 275, 365]);
  });

  it("of uneven longitudes end at 360 degrees", () => {
    const uneven = closedGrid(2, 36, (i, j) => [j === 35 ? 349 : 10 * j, i, 0]);
    expect(xOf(unrolled(uneven, true, {})).at(-1)).toBe(360);
    const cells = closedGrid(2, 36, (i, j) => [j, i, 0]);
    expect(xOf(unrolled(cells, true, {})).at(-1)).toBe(36);
  });

  it("end where a list of uneven longitudes says, at every level", () => {
    const line = Array.from({ length: 37 }, (_, j) => 30 + 20 * Math.floor(j / 2) + 4 * (j % 2));
    const axes = { x: [...line, "values"], y: [0, 1] };
    const uneven = closedGrid(2, 36, (i, j) => [line[j]!, i, 0]);
    expect(xOf(unrolled(uneven, true, { axes }))).toEqual(line);
    const coarse = { ...closedGrid(2, 4, (i, j) => [line[9 * j]!, i, 0]), columnsAt: Float64Array.of(0, 9, 18, 27) };
    expect(xOf(unrolled({ ...coarse, full: [2, 36] }, true, { axes })).at(-1)).toBe(390);
  });

  it.each([angles, {}, { turn: [0, 360, 1] }])("of x, y, z that are longitudes end a turn further: %o", (metadata) => {
    const grid = unrolled(map, false, metadata);
    expect(grid.closed[1]).toBe(false);
    expect(xOf(grid, 4)).toEqual(Array.from({ length: 37 }, (_, j) => 5 + 10 * j));
    const west = closedGrid(5, 36, (i, j) => [180 - 10 * j, i, 0]);
    expect(xOf(unrolled(west, false, metadata)).at(-1)).toBe(-180);
  });

  it("of what is closed in space stay closed", () => {
    const ring = closedGrid(5, 36, (i, j) => [400 * Math.cos(j / 5.73), 400 * Math.sin(j / 5.73), i]);
    expect(unrolled(ring, false, {})).toBe(ring);
    expect(unrolled(ring, false, angles).closed).toEqual([false, true]);
  });

  it("have the holes of their first line", () => {
    const mask = new Uint8Array(5 * 36).fill(1);
    mask[2 * 36] = 0;
    const grid = unrolled({ ...map, mask }, true, {});
    expect(grid.mask![2 * 37 + 36]).toBe(0);
    expect([...grid.mask!].filter((valid) => valid === 0)).toHaveLength(2);
  });

  it("along rows open likewise", () => {
    const points = new Float64Array(map.points.length);
    for (let i = 0; i < 36; i += 1) for (let j = 0; j < 5; j += 1) points.set([10 * i, j, 0], 3 * (5 * i + j));
    const turned: Grid = { ...map, rowsAt: ramp(36), columnsAt: ramp(5), full: [36, 5], closed: [true, false], points };
    const grid = unrolled(turned, true, {});
    expect(grid.rowsAt).toHaveLength(37);
    expect([...grid.points.subarray(3 * 5 * 36, 3 * 5 * 36 + 2)]).toEqual([360, 0]);
  });

  it("leave no triangle across which a longitude jumps by more than half a turn", () => {
    const jumping = closedGrid(6, 36, (i, j) => [10 * j + (i > 2 ? 360 : 0), i, 0]);
    expect(longest(unrolled(jumping, false, angles))).toBeCloseTo(10, 3);
    const geometry = new Geometry();
    const options = { joined: false, geographic: false, heights: false, diagonal: 0, relief: 0, fresh: true };
    geometry.setPicture([unrolled(jumping, false, angles)], options);
    const { origin, scale } = geometry.frame;
    const pick = (x: number, y: number) =>
      geometry.pick([(x - origin[0]) * scale[0], (y - origin[1]) * scale[1], 5], [0, 0, -1]);
    expect(pick(100, 1.5)?.column).toBeCloseTo(10, 6);
    expect(pick(355, 1.5)?.column).toBeCloseTo(35.5, 6);
    expect(pick(280, 2.5)).toBeNull();
  });
});
