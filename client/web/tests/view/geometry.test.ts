import { describe, expect, it } from "vitest";
import { NO_VALUE } from "../../src/view/fields";
import { Geometry } from "../../src/view/geometry";
import type { Eye, PatchBuffers } from "../../src/view/geometry-messages";
import { piecesOf } from "../../src/view/patches";
import type { Grid } from "../../src/view/source";
import { ArtificialSource, type ArtificialSurface, BLOCKS, MOUNTAINS, SPHERE, TORUS } from "./artificial";
import { areaOf, edgesOf, eulerNumber, openEdges } from "./meshes";

/** A view from a place in drawn coordinates that sees everything, or nothing but a narrow cone. */
function eyeAt(position: [number, number, number], focal: number): Eye {
  const matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1e9];
  return { matrix, position, focal, exaggeration: 1 };
}

function plane(rows: number, columns: number, height: (row: number, column: number) => number | null): Grid {
  const points = new Float64Array(3 * rows * columns);
  const mask = new Uint8Array(rows * columns).fill(1);
  for (let i = 0; i < rows; i += 1) {
    for (let j = 0; j < columns; j += 1) {
      const z = height(i, j);
      points.set([j, i, z ?? Number.NaN], 3 * (i * columns + j));
      if (z === null) mask[i * columns + j] = 0;
    }
  }
  const ramp = (n: number): Float64Array => Float64Array.from({ length: n }, (_, k) => k);
  return {
    rowsAt: ramp(rows),
    columnsAt: ramp(columns),
    full: [rows, columns],
    closed: [false, false],
    points,
    mask: mask.includes(0) ? mask : null,
    attributes: [
      { name: "twice", components: 1, values: Float64Array.from({ length: rows * columns }, (_, k) => 2 * k) },
    ],
  };
}

/** All patches as they stand after some changes. */
class Drawn {
  readonly geometry = new Geometry();
  readonly patches = new Map<number, PatchBuffers>();

  picture(grids: Grid[], joined = false): this {
    this.patches.clear();
    return this.take(
      this.geometry.setPicture(grids, {
        joined,
        geographic: false,
        heights: false,
        diagonal: 0,
        relief: 0,
        fresh: false,
      }).patches,
    );
  }

  eye(eye: Eye): this {
    return this.take(this.geometry.setEye(eye).patches);
  }

  take(patches: PatchBuffers[]): this {
    for (const patch of patches) this.patches.set(patch.patch, patch);
    return this;
  }

  get triangles(): number {
    return [...this.patches.values()].reduce((sum, { triangles }) => sum + triangles.length / 3, 0);
  }
}

async function grids(surface: ArtificialSurface, level = 7, moment = 7): Promise<Grid[]> {
  return [...(await new ArtificialSource(surface).grids(moment, level)).grids];
}

describe("patches of different strides", () => {
  it.each([
    [100, 130, 0.3],
    [129, 97, 0.3],
    [131, 77, 0.4],
    [33, 300, 0.5],
  ])("cover %i x %i nodes once, without cracks", (rows, columns, focal) => {
    const drawn = new Drawn().picture([plane(rows, columns, (i, j) => Math.sin(i / 9) * Math.cos(j / 7))]);
    const whole = areaOf(drawn.patches.values());
    const strides = new Set<number>();
    for (const position of [
      [-1, -0.6, 0.05],
      [0, 0, 0.02],
      [1, 0.3, 0.1],
    ] as [number, number, number][]) {
      drawn.eye(eyeAt(position, 200 * focal));
      for (const { places } of drawn.patches.values()) strides.add(places[3]! - places[1]!);
      const area = areaOf(drawn.patches.values());
      expect(area.signed).toBeCloseTo(whole.signed, 4);
      expect(area.unsigned).toBeCloseTo(whole.signed, 4);
      // What is open lies on the outline, which is a rectangle.
      const { box, frame } = drawn.geometry;
      const outline = (axis: 0 | 1) =>
        box.map((corner) => Math.fround((corner[axis] - frame.origin[axis]) * frame.scale[axis]));
      const [xs, ys] = [outline(0), outline(1)];
      const inside = openEdges(edgesOf(drawn.patches.values(), ({ positions }) => positions)).filter(
        (ends) =>
          ![...xs.map((x) => ends.every(([a]) => a === x)), ...ys.map((y) => ends.every(([, b]) => b === y))].includes(
            true,
          ),
      );
      expect(inside).toEqual([]);
    }
    expect(strides.size).toBeGreaterThan(1);
  });

  it("have no more triangles than allowed, near or far", () => {
    const drawn = new Drawn().picture([plane(700, 700, (i, j) => i * j * 1e-3)]);
    expect(drawn.triangles).toBe(2 * 699 * 699);
    drawn.geometry.setMost(50_000);
    drawn.eye(eyeAt([0, 0, 0.01], 1e6));
    expect(drawn.triangles).toBeLessThanOrEqual(50_000);
    expect(drawn.triangles).toBeGreaterThan(5_000);
  });
});

describe("closed surfaces", () => {
  it("a torus is closed at every stride", async () => {
    const drawn = new Drawn().picture(await grids(TORUS));
    for (const focal of [1e5, 300, 60]) {
      drawn.eye(eyeAt([1, 0.4, 0.3], focal));
      const edges = edgesOf(drawn.patches.values(), ({ positions }) => positions);
      expect(openEdges(edges)).toEqual([]);
      expect([...edges.count.values()].every((count) => count === 1)).toBe(true);
      expect(eulerNumber(edges)).toBe(0); // Euler's number of a torus
    }
  });

  it("a sphere has two poles and no seam", async () => {
    const drawn = new Drawn().picture(await grids(SPHERE));
    for (const focal of [1e5, 150]) {
      drawn.eye(eyeAt([1.2, 0.1, 0.9], focal));
      const edges = edgesOf(drawn.patches.values(), ({ positions }) => positions);
      expect(openEdges(edges)).toEqual([]);
      expect(eulerNumber(edges)).toBe(2);
    }
    let least = 1;
    for (const { positions, normals } of drawn.patches.values()) {
      for (let node = 0; 3 * node < positions.length; node += 1) {
        const [x, y, z] = positions.subarray(3 * node, 3 * node + 3);
        const along = (x! * normals[4 * node]! + y! * normals[4 * node + 1]! + z! * normals[4 * node + 2]!) / 127;
        least = Math.min(least, Math.abs(along));
      }
    }
    expect(least).toBeGreaterThan(0.95); // everywhere, the poles included
  });

  it("blocks meet without gaps, and their normals are one across a seam", async () => {
    const drawn = new Drawn().picture(await grids(BLOCKS), true);
    const edges = edgesOf(drawn.patches.values(), ({ positions }) => positions);
    const undirected = new Map<string, number>();
    for (const [edge, count] of edges.count) {
      const [a, b] = [Math.floor(edge / edges.nodes.length), edge % edges.nodes.length];
      const key = `${Math.min(a, b)} ${Math.max(a, b)}`;
      undirected.set(key, (undirected.get(key) ?? 0) + count);
    }
    expect([...undirected.values()].every((count) => count === 2)).toBe(true);
    const normals = new Map<string, number[][]>();
    for (const patch of drawn.patches.values()) {
      for (let node = 0; 3 * node < patch.positions.length; node += 1) {
        const key = patch.positions.subarray(3 * node, 3 * node + 3).join();
        normals.set(key, [...(normals.get(key) ?? []), [...patch.normals.subarray(4 * node, 4 * node + 3)]]);
      }
    }
    const shared = [...normals.values()].filter((of) => of.length > 1);
    expect(shared.length).toBeGreaterThan(300);
    for (const [first, ...others] of shared) {
      for (const other of others) {
        const dot = first!.reduce((sum, value, k) => sum + value * other[k]!, 0) / 127 ** 2;
        expect(Math.abs(dot)).toBeGreaterThan(0.97);
      }
    }
  });
});

describe("holes", () => {
  it("are not drawn, and nothing else is left out", () => {
    const drawn = new Drawn().picture([plane(20, 20, (i, j) => (i === 9 && j === 9 ? null : 1))]);
    expect(drawn.triangles).toBe(2 * 19 * 19 - 6); // a node has six triangles
    for (const { positions, triangles } of drawn.patches.values()) {
      for (const node of triangles) expect(Number.isFinite(positions[3 * node])).toBe(true);
    }
  });

  it("have no value", async () => {
    const drawn = new Drawn().picture(await grids(MOUNTAINS));
    const values = [...drawn.patches.values()].flatMap((patch) => [...patch.values]);
    expect(values.filter((value) => value === Math.fround(NO_VALUE)).length).toBeGreaterThan(50);
    const drawnOnly = [...drawn.patches.values()].flatMap((patch) =>
      [...patch.triangles].map((node) => patch.values[node]!),
    );
    expect(drawnOnly.reduce((low, value) => Math.min(low, value), 9)).toBe(0);
    expect(drawnOnly.reduce((high, value) => Math.max(high, value), -9)).toBe(1);
  });
});

describe("blending", () => {
  it("begins with what was drawn: a coarser surface, without cracks", async () => {
    const source = new ArtificialSource(TORUS);
    const [coarse, fine] = [await source.grids(3, 3), await source.grids(4, 4)];
    const drawn = new Drawn().picture([...coarse.grids]).picture([...fine.grids]);
    const edges = edgesOf(drawn.patches.values(), ({ from }) => from!);
    expect(openEdges(edges)).toEqual([]);
  });

  it("of a plane is the plane, wherever the new nodes lie", () => {
    const coarse: Grid = {
      ...plane(5, 5, (i, j) => i + 2 * j),
      rowsAt: Float64Array.of(0, 4, 8, 12, 15),
      full: [16, 16],
      columnsAt: Float64Array.of(0, 4, 8, 12, 15),
    };
    for (let node = 0; node < 25; node += 1) {
      const [row, column] = [coarse.rowsAt[Math.floor(node / 5)]!, coarse.columnsAt[node % 5]!];
      coarse.points.set([column, row, row + 2 * column], 3 * node);
    }
    const drawn = new Drawn().picture([coarse]).picture([plane(16, 16, (i, j) => i + 2 * j)]);
    for (const { positions, from } of drawn.patches.values()) {
      from!.forEach((value, k) => {
        expect(value).toBeCloseTo(positions[k]!, 6);
      });
    }
  });

  it("of the same picture shows it as it is, to its ends", () => {
    const bowl = (): Grid => plane(9, 12, (i, j) => (i - 3) ** 2 / 9 + j / 5);
    const drawn = new Drawn().picture([bowl()]).picture([bowl()]);
    for (const { normals, fromNormals } of drawn.patches.values()) expect(fromNormals).toEqual(normals);
  });

  it("reports the last change along the normal, in the surface's unit", () => {
    const drawn = new Drawn().picture([plane(9, 9, () => 1)]).picture([plane(9, 9, () => 3.5)]);
    drawn.take(drawn.geometry.setField({ kind: "change" }).patches);
    const { low, span, range } = drawn.geometry.colouring();
    expect(range[1]).toBeCloseTo(2.5, 9);
    for (const { values } of drawn.patches.values()) {
      for (const value of values) expect(low + span * value).toBeCloseTo(2.5, 5);
    }
  });
});

describe("colours and values", () => {
  it("slope is the angle of the surface, whatever its frame", () => {
    const drawn = new Drawn().picture([plane(30, 40, (i) => i)]);
    drawn.take(drawn.geometry.setField({ kind: "slope" }).patches);
    expect(drawn.geometry.colouring().range[0]).toBeCloseTo(45, 6);
  });

  it("slope is that of the coordinates where heights are drawn at a scale of their own", () => {
    const geometry = new Geometry();
    const options = { joined: false, geographic: false, heights: true, diagonal: 0, relief: 0, fresh: true };
    geometry.setPicture([plane(30, 40, (i) => 100 * i)], options);
    expect(geometry.frame.scale[2]).not.toBeCloseTo(geometry.frame.scale[0], 3);
    geometry.setField({ kind: "slope" });
    expect(geometry.colouring().range[0]).toBeCloseTo((Math.atan(100) * 180) / Math.PI, 6);
  });

  it("an attribute has its own range", () => {
    const drawn = new Drawn().picture([plane(3, 4, () => 0)]);
    drawn.take(drawn.geometry.setField({ kind: "attribute", name: "twice", component: 0 }).patches);
    expect(drawn.geometry.colouring().range).toEqual([0, 22]);
    const { low, span } = drawn.geometry.colouring();
    expect([...drawn.patches.get(0)!.values].map((value) => Math.round(low + span * value))).toEqual([
      0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22,
    ]);
  });

  it("a ray finds the node it was aimed at, and passes through holes", () => {
    const grid = plane(90, 70, (i, j) => (i === 40 && j === 30 ? null : Math.sin(i / 5) + j / 10));
    const { geometry } = new Drawn().picture([grid]);
    const { origin, scale } = geometry.frame;
    const towards = (row: number, column: number) => {
      const z = Number.isFinite(grid.points[3 * (row * 70 + column) + 2])
        ? grid.points[3 * (row * 70 + column) + 2]!
        : 0;
      const at = [column, row, z].map((value, k) => (value - origin[k]!) * scale[k]!) as [number, number, number];
      return geometry.pick([at[0], at[1], 5], [0, 0, -1]);
    };
    const hit = towards(17, 55);
    expect(hit?.row).toBeCloseTo(17, 6);
    expect(hit?.column).toBeCloseTo(55, 6);
    expect(hit?.at[2]).toBeCloseTo(grid.points[3 * (17 * 70 + 55) + 2]!, 9);
    expect(towards(40, 30)).toBeNull();
  });
});

describe("lines of points", () => {
  const line = (rows: number, columns: number, hole = -1) =>
    plane(rows, columns, (i, j) => (i + j === hole ? null : Math.sin((i + j) / 10)));

  it.each([
    [1, 300],
    [300, 1],
  ])("%i x %i are drawn from end to end, at any stride", (rows, columns) => {
    const drawn = new Drawn().picture([line(rows, columns)]);
    for (const focal of [1e5, 20]) {
      drawn.eye(eyeAt([0, -2, 0.5], focal));
      let length = 0;
      for (const { pieces, positions, triangles } of drawn.patches.values()) {
        expect(triangles).toHaveLength(0);
        for (let k = 0; k < pieces!.length; k += 2) {
          const [a, b] = [3 * pieces![k]!, 3 * pieces![k + 1]!];
          length += Math.hypot(positions[b]! - positions[a]!, positions[b + 1]! - positions[a + 1]!);
        }
      }
      expect(length).toBeCloseTo(2, 4);
    }
  });

  it("leave holes out, and draw a point that stands alone", () => {
    expect([...piecesOf(Uint8Array.of(1, 1, 0, 1, 0, 0, 1, 1, 1))]).toEqual([0, 1, 3, 3, 6, 7, 7, 8]);
    expect([...piecesOf(Uint8Array.of(1))]).toEqual([0, 0]);
    const drawn = new Drawn().picture([plane(1, 1, () => 5)]);
    expect([...drawn.patches.get(0)!.pieces!]).toEqual([0, 0]);
  });

  it("are found by a ray that passes close by", () => {
    const { geometry } = new Drawn().picture([line(1, 90, 40)]);
    const towards = (column: number, off: number) => {
      const { origin, scale } = geometry.frame;
      return geometry.pick([(column - origin[0]) * scale[0], off, 5], [0, 0, -1]);
    };
    const hit = towards(17, 0.01);
    expect([hit?.row, hit?.column]).toEqual([0, expect.closeTo(17, 6)]);
    expect(towards(17, 0.5)).toBeNull();
    expect(towards(62.25, 0)?.column).toBeCloseTo(62.25, 6);
  });
});
