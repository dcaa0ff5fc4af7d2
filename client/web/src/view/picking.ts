/** Where a ray meets the grids in hand. */

import type { Hit } from "./geometry-messages";
import { type Frame, latticeOf, placesOf } from "./lattice";
import { jumps } from "./maps";
import { isLine, linesOf } from "./patches";
import type { Grid } from "./source";
import type { PatchBounds } from "./strides";

type Triple = readonly [number, number, number];

/** A line is met by rays that pass it by no more than this share of the distance, a few pixels. */
const BESIDE = 0.012;

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
    .map((of) => ({ of, enters: isLine(of.patch) ? 0 : entry(of, origin, direction) }))
    .filter(({ enters }) => enters < Number.POSITIVE_INFINITY)
    .sort((a, b) => a.enters - b.enters);
  let found: Met | null = null;
  for (const { of, enters } of met) {
    if (found !== null && found.hit.distance < enters) break;
    const find = isLine(of.patch) ? onLine : inPatch;
    const met = find(grids[of.patch.block]!, of, frame, origin, direction);
    if (met !== null && (found === null || isBetter(met, found))) found = met;
  }
  return found?.hit ?? null;
}

/** A hit, and by which share of its distance a ray passes beside it; null: it meets a triangle. */
interface Met {
  readonly hit: Hit;
  readonly off: number | null;
}

/** Of surfaces the nearest one, of lines the one that the ray passes more closely. */
function isBetter(a: Met, b: Met): boolean {
  return a.off !== null && b.off !== null ? a.off < b.off : a.hit.distance < b.hit.distance;
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

function inPatch(grid: Grid, of: PatchBounds, frame: Frame, origin: Triple, direction: Triple): Met | null {
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
        if (grid.periods !== undefined && jumps(lattice.points, [a, p, q], frame.scale, grid.periods)) continue;
        const met = meets(origin, direction, node(a), node(p), node(q));
        if (met === null || (best !== null && met.distance >= best.distance)) continue;
        // Corners of the triangle in lines from node a: (0, 0), then p and q.
        const [row, column] = upper ? [met.v, met.u + met.v] : [met.u + met.v, met.u];
        best = { distance: met.distance, row: i + row, column: j + column };
      }
    }
  }
  return best === null ? null : { hit: hitAt(grid, of, frame, origin, direction, best), off: null };
}

/** The point of a line that a ray passes nearest to, if it is near. */
function onLine(grid: Grid, of: PatchBounds, frame: Frame, origin: Triple, direction: Triple): Met | null {
  const [rows, columns] = [linesOf(of.patch.rows, 1), linesOf(of.patch.columns, 1)];
  const { points, valid } = latticeOf(grid, rows, columns, frame);
  const node = (k: number): Triple => [points[3 * k]!, points[3 * k + 1]!, points[3 * k + 2]!];
  let least = BESIDE;
  let best: { distance: number; row: number; column: number } | null = null;
  for (let k = 0; k < valid.length; k += 1) {
    if (valid[k] === 0) continue;
    const [a, b] = [node(k), node(valid[k + 1] === 1 ? k + 1 : k)];
    const [v, w] = [minus(b, a), minus(origin, a)];
    const [uu, uv, vv] = [dot(direction, direction), dot(direction, v), dot(v, v)];
    const [uw, vw] = [dot(direction, w), dot(v, w)];
    const spread = uu * vv - uv * uv;
    const share = spread > 0 ? Math.min(Math.max((uu * vw - uv * uw) / spread, 0), 1) : 0;
    const distance = (uv * share - uw) / uu;
    const gap = Math.hypot(...([0, 1, 2] as const).map((i) => w[i] + distance * direction[i] - share * v[i]));
    const off = gap / (distance * Math.sqrt(uu));
    if (distance <= 0 || off >= least) continue;
    least = off;
    best = rows.length === 1 ? { distance, row: 0, column: k + share } : { distance, row: k + share, column: 0 };
  }
  return best === null ? null : { hit: hitAt(grid, of, frame, origin, direction, best), off: least };
}

/** @param best - Distance along the ray, and lines of the patch. */
function hitAt(
  grid: Grid,
  of: PatchBounds,
  frame: Frame,
  origin: Triple,
  direction: Triple,
  best: { readonly distance: number; readonly row: number; readonly column: number },
): Hit {
  const [rows, columns] = [linesOf(of.patch.rows, 1), linesOf(of.patch.columns, 1)];
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
  if (places.length === 1) return places[0]!;
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
