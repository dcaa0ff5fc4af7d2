/** Which level of a surface is computed for the view. */

import type { SurfaceInfo } from "./source";

/** Points of all blocks at a level, about. */
export function pointsAt(info: SurfaceInfo, level: number): number {
  const halvings = info.levels - level;
  return info.blocks.reduce((sum, { shape }) => {
    const [rows, columns] = shape.map((length) => Math.max(2, length / 2 ** halvings));
    return sum + rows! * columns!;
  }, 0);
}

/** Points that are kept in memory as numbers at most. */
const MOST_POINTS = 6_000_000;

/**
 * The finest level that is drawn at all: of a surface whose blocks are joined, the one whose triangles are no more than
 * allowed; of another one, whose patches are thinned, the one that memory holds.
 */
export function finestDrawn(info: SurfaceInfo, triangles: number): number {
  const most = info.joined || info.blocks.length > 1 ? triangles / 2 : MOST_POINTS;
  for (let level = info.levels; level > 0; level -= 1) {
    if (pointsAt(info, level) <= most) return level;
  }
  return 0;
}

/** The level of the first picture, before any view: as many points as a view has pixels, about. */
export function firstLevel(info: SurfaceInfo, pixels: number): number {
  for (let level = info.levels; level > 0; level -= 1) {
    if (pointsAt(info, level) <= Math.max(pixels, 10_000)) return level;
  }
  return 0;
}
