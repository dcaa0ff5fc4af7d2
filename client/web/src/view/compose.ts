/** A part of a surface in detail, in the middle of the rest of it as a coarser grid: one grid, so that nothing gapes. */

import { between, interpolated } from "./lattice";
import type { AttributeGrid, Grid } from "./source";

/** The lines of the coarse grid outside the detailed part, and those of the part, in order. */
function merged(coarse: Float64Array, fine: Float64Array): { at: Float64Array; first: number } {
  const [low, high] = [fine[0]!, fine.at(-1)!];
  const before = coarse.filter((place) => place < low);
  const after = coarse.filter((place) => place > high);
  const at = new Float64Array(before.length + fine.length + after.length);
  at.set(before);
  at.set(fine, before.length);
  at.set(after, before.length + fine.length);
  return { at, first: before.length };
}

/**
 * One grid from a coarse one and a detailed part of the same block.
 *
 * @param coarse - The whole block.
 * @param fine - A part of it, whose `full` and axes are those of the whole.
 * @returns a grid with the lines of both. In the part its values are those of `fine`; elsewhere they are interpolated in
 * `coarse`, and a node is a hole where the nearest node of `coarse` is one.
 */
export function composed(coarse: Grid, fine: Grid): Grid {
  const { full, closed } = coarse;
  const [rows, columns] = [merged(coarse.rowsAt, fine.rowsAt), merged(coarse.columnsAt, fine.columnsAt)];
  const down = between([...rows.at], coarse.rowsAt, full[0], closed[0]);
  const across = between([...columns.at], coarse.columnsAt, full[1], closed[1]);
  const width = coarse.columnsAt.length;
  const [count, inner] = [columns.at.length, fine.columnsAt.length];
  const valid = (node: number): boolean => coarse.mask?.[node] !== 0;
  /** Puts the part's own values in the place of interpolated ones. */
  const inserted = (put: (to: number, from: number) => void): void => {
    for (let i = 0; i < fine.rowsAt.length; i += 1) {
      for (let j = 0; j < inner; j += 1) put((rows.first + i) * count + columns.first + j, i * inner + j);
    }
  };

  const points = new Float64Array(3 * rows.at.length * count);
  for (const k of [0, 1, 2]) {
    const channel = interpolated(down, across, width, (node) =>
      valid(node) ? coarse.points[3 * node + k]! : Number.NaN,
    );
    channel.forEach((value, node) => {
      points[3 * node + k] = value;
    });
  }
  inserted((to, from) => points.set(fine.points.subarray(3 * from, 3 * from + 3), 3 * to));

  let mask: Uint8Array | null = null;
  if (coarse.mask !== null || fine.mask !== null) {
    const found = new Uint8Array(rows.at.length * count);
    for (let i = 0; i < rows.at.length; i += 1) {
      const row = down.share[i]! > 0.5 ? down.above[i]! : down.below[i]!;
      for (let j = 0; j < count; j += 1) {
        const column = across.share[j]! > 0.5 ? across.above[j]! : across.below[j]!;
        found[i * count + j] = valid(row * width + column) ? 1 : 0;
      }
    }
    inserted((to, from) => {
      found[to] = fine.mask?.[from] ?? 1;
    });
    mask = found;
  }

  const attributes = coarse.attributes.map(({ name, components, values }): AttributeGrid => {
    const own = fine.attributes.find((attribute) => attribute.name === name)!;
    const result = new Float64Array(rows.at.length * count * components);
    for (let k = 0; k < components; k += 1) {
      interpolated(down, across, width, (node) => values[node * components + k]!).forEach((value, node) => {
        result[node * components + k] = value;
      });
    }
    inserted((to, from) =>
      result.set(own.values.subarray(from * components, (from + 1) * components), to * components),
    );
    return { name, components, values: result };
  });
  return { ...coarse, rowsAt: rows.at, columnsAt: columns.at, points, mask, attributes };
}

/** Every stride-th line of a grid, and the last one. */
export function thinned(grid: Grid, stride: number): Grid {
  if (stride === 1) return grid;
  const lines = (length: number): number[] => {
    const all: number[] = [];
    for (let k = 0; k < length - 1; k += stride) all.push(k);
    return [...all, length - 1];
  };
  const [rows, columns] = [lines(grid.rowsAt.length), lines(grid.columnsAt.length)];
  const width = grid.columnsAt.length;
  const nodes = rows.flatMap((row) => columns.map((column) => row * width + column));
  const taken = (values: Float64Array, components: number): Float64Array => {
    const result = new Float64Array(nodes.length * components);
    nodes.forEach((node, k) => {
      result.set(values.subarray(node * components, (node + 1) * components), k * components);
    });
    return result;
  };
  const { mask } = grid;
  return {
    ...grid,
    rowsAt: Float64Array.from(rows, (row) => grid.rowsAt[row]!),
    columnsAt: Float64Array.from(columns, (column) => grid.columnsAt[column]!),
    points: taken(grid.points, 3),
    mask: mask === null ? null : Uint8Array.from(nodes, (node) => mask[node]!),
    attributes: grid.attributes.map(({ name, components, values }) => ({
      name,
      components,
      values: taken(values, components),
    })),
  };
}
