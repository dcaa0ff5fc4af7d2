/**
 * Normals along the ends of blocks, where points of several places are one: at seams between blocks, at poles, along
 * rows or columns that are repeated. The normals of all of them are added, so that no edge shows where there is none.
 */

import { type Frame, latticeOf } from "./lattice";
import { normalSums } from "./normals";
import type { Grid } from "./source";

/** Sums of normals, [xyz], by block and node. */
export type BoundaryNormals = ReadonlyMap<number, ReadonlyMap<number, readonly [number, number, number]>>;

/** Only normals that differ by less than this are added: beyond it there is an edge. The cosine. */
const EDGE = 0.5;

interface Place {
  readonly block: number;
  readonly node: number;
  readonly normal: [number, number, number];
}

/** The normals of those points on the ends of blocks that coincide with others, bit for bit. */
export function boundaryNormals(grids: readonly Grid[], frame: Frame): BoundaryNormals {
  const places = new Map<string, Place[]>();
  grids.forEach((grid, block) => {
    for (const place of ends(grid, block, frame)) {
      const { node } = place;
      const key = grid.points.subarray(3 * node, 3 * node + 3).join();
      const group = places.get(key);
      if (group === undefined) places.set(key, [place]);
      else if (!group.some((other) => other.block === block && other.node === node)) group.push(place);
    }
  });
  const result = new Map<number, Map<number, readonly [number, number, number]>>();
  for (const group of places.values()) {
    if (group.length < 2) continue;
    for (const { block, node, normal } of group) {
      const sum: [number, number, number] = [0, 0, 0];
      for (const other of group) {
        const along = dot(normal, other.normal);
        const both = Math.sqrt(dot(normal, normal) * dot(other.normal, other.normal));
        // Blocks may be oriented differently; a normal of 0, as at a pole, takes part in any case.
        if (both > 0 && Math.abs(along) < EDGE * both) continue;
        const sign = along < 0 ? -1 : 1;
        for (const k of [0, 1, 2] as const) sum[k] += sign * other.normal[k];
      }
      if (!result.has(block)) result.set(block, new Map());
      result.get(block)!.set(node, sum);
    }
  }
  return result;
}

const dot = (a: readonly number[], b: readonly number[]): number => a[0]! * b[0]! + a[1]! * b[1]! + a[2]! * b[2]!;

function* ends(grid: Grid, block: number, frame: Frame): Generator<Place> {
  const [height, width] = [grid.rowsAt.length, grid.columnsAt.length];
  const all = (length: number): number[] => Array.from({ length }, (_, k) => k);
  const strips: [number[], number[]][] = [];
  if (!grid.closed[0]) for (const row of new Set([0, height - 1])) strips.push([[row], all(width)]);
  if (!grid.closed[1]) for (const column of new Set([0, width - 1])) strips.push([all(height), [column]]);
  for (const [rows, columns] of strips) {
    const around = (lines: number[]): number[] => [lines[0]! - 1, ...lines, lines.at(-1)! + 1];
    const sums = normalSums(latticeOf(grid, around(rows), around(columns), frame));
    for (const [i, row] of rows.entries()) {
      for (const [j, column] of columns.entries()) {
        const node = row * width + column;
        const at = 3 * (i * columns.length + j);
        if (grid.mask?.[node] !== 0) yield { block, node, normal: [sums[at]!, sums[at + 1]!, sums[at + 2]!] };
      }
    }
  }
}
