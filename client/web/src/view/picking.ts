/** Where a ray meets the grids in hand. */

import type { Hit } from "./geometry-messages";
import { type Frame, latticeOf, placesOf } from "./lattice";
import { linesOf } from "./patches";
import type { Grid } from "./source";
import type { PatchBounds } from "./strides";

type Triple = readonly [number, number, number];

/**
 * The nearest place at which a ray meets a surface.
 *
 * @param bounds - Of all patches, in drawn coordinates.
 * @param origin - In drawn coordinates before exaggeration.
 * @param direction - Likewise, of any length.
 * @returns null where it meets none.
 */
export function pick(
  grids: readonly Grid[],
  bounds: readonly PatchBounds[],
  frame: Frame,
  origin: Triple,
  direction: Triple,
): Hit | null {
  const met = bounds
    .map((of) => ({ of, enters: entry(of, origin, direction) }))
    .filter(({ enters }) => enters < Number.POSITIVE_INFINITY)
    .sort((a, b) => a.enters - b.enters);
  let found: Hit | null = null;
  for (const { of, enters } of met) {
    if (found !== null && found.distance < enters) break;
    const hit = inPatch(grids[of.patch.block]!, of, frame, origin, direction);
    if (hit !== null && (found === null || hit.distance < found.distance)) found = hit;
  }
  return found;
}

/** How many directions along the ray its first point inside a box is; infinite where it misses. */
function entry(of: PatchBounds, origin: Triple, direction: Triple): number {
  let [first, last] = [0, Number.POSITIVE_INFINITY];
  for (const k of [0, 1, 2] as const) {
    const margin = 1e-9 + of.half[k] * 1e-6;
    const [low, high] = [of.centre[k] - of.half[k] - margin, of.centre[k] + of.half[k] + margin];
    if (direction[k] === 0) {
      if (origin[k] < low || origin[k] > high) return Number.POSITIVE_INFINITY;
      continue;
    }
    const [a, b] = [(low - origin[k]) / direction[k], (high - origin[k]) / direction[k]];
    first = Math.max(first, Math.min(a, b));
    last = Math.min(last, Math.max(a, b));
  }
  return first <= last ? first : Number.POSITIVE_INFINITY;
}

function inPatch(grid: Grid, of: PatchBounds, frame: Frame, origin: Triple, direction: Triple): Hit | null {
  const [rows, columns] = [linesOf(of.patch.rows, 1), linesOf(of.patch.columns, 1)];
  const lattice = latticeOf(grid, rows, columns, frame);
  const node = (k: number): Triple => [lattice.points[3 * k]!, lattice.points[3 * k + 1]!, lattice.points[3 * k + 2]!];
  let best: { distance: number; row: number; column: number } | null = null;
  for (let i = 0; i + 1 < rows.length; i += 1) {
    for (let j = 0; j + 1 < columns.length; j += 1) {
      const a = i * columns.length + j;
      const [b, c, d] = [a + 1, a + columns.length, a + columns.length + 1];
      for (const [p, q, upper] of [
        [b, d, true],
        [d, c, false],
      ] as const) {
        if (lattice.valid[a] === 0 || lattice.valid[p] === 0 || lattice.valid[q] === 0) continue;
        const met = meets(origin, direction, node(a), node(p), node(q));
        if (met === null || (best !== null && met.distance >= best.distance)) continue;
        // Corners of the triangle in lines from node a: (0, 0), then p and q.
        const [row, column] = upper ? [met.v, met.u + met.v] : [met.u + met.v, met.u];
        best = { distance: met.distance, row: i + row, column: j + column };
      }
    }
  }
  if (best === null) return null;
  const [rowsAt, columnsAt] = [
    placesOf(rows, grid.rowsAt, grid.full[0], grid.closed[0]),
    placesOf(columns, grid.columnsAt, grid.full[1], grid.closed[1]),
  ];
  const { distance } = best;
  const at = ([0, 1, 2] as const).map(
    (k) => (origin[k] + distance * direction[k]) / frame.scale[k] + frame.origin[k],
  ) as [number, number, number];
  return { block: of.patch.block, row: along(rowsAt, best.row), column: along(columnsAt, best.column), at, distance };
}

function along(places: readonly number[], at: number): number {
  const below = Math.min(Math.floor(at), places.length - 2);
  return places[below]! + (places[below + 1]! - places[below]!) * (at - below);
}

/** Moeller and Trumbore's intersection of a ray with a triangle, from both sides; u and v belong to b and c. */
function meets(
  origin: Triple,
  direction: Triple,
  a: Triple,
  b: Triple,
  c: Triple,
): { distance: number; u: number; v: number } | null {
  const [e, f] = [minus(b, a), minus(c, a)];
  const p = times(direction, f);
  const determinant = dot(e, p);
  if (determinant === 0) return null;
  const from = minus(origin, a);
  const u = dot(from, p) / determinant;
  if (!(u >= -1e-9 && u <= 1 + 1e-9)) return null;
  const q = times(from, e);
  const v = dot(direction, q) / determinant;
  if (!(v >= -1e-9 && u + v <= 1 + 1e-9)) return null;
  const distance = dot(f, q) / determinant;
  return distance > 0 ? { distance, u, v } : null;
}

const minus = (a: Triple, b: Triple): Triple => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a: Triple, b: Triple): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const times = (a: Triple, b: Triple): Triple => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
