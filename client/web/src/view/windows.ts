/** Which part of a surface is drawn in more detail than the rest, of one too large to be drawn whole at a fine level. */

import { finestDrawn, pointsAt } from "./levels";
import type { DetailWindow, Region, SurfaceInfo } from "./source";

/** Points of a part that are drawn, and that are decoded for it. */
const MOST_DRAWN = 1_500_000;
const MOST_DECODED = 16_000_000;
/** Points of the rest. */
const MOST_AROUND = 400_000;
/** Share of its length by which a part extends beyond the view on either side. */
const MARGIN = 0.2;

/** What is drawn: all of it at a level, perhaps with a part in more detail. */
export interface Drawing {
  readonly level: number;
  readonly window: DetailWindow | null;
}

/**
 * What to draw for a view: up to a level finer than the data, since between the nodes that have come the surface is then
 * smooth, where triangles would be flat. A part in more detail needs data of its own.
 *
 * @param wanted - The finest level that shows a difference in the view.
 * @param data - The finest level with data.
 * @param region - What is in the view; null: most of it, or that is not known.
 * @param before - The window that is drawn now; kept while the view stays inside.
 */
export function drawingFor(
  info: SurfaceInfo,
  triangles: number,
  wanted: number,
  data: number,
  region: Region | null,
  before: DetailWindow | null,
): Drawing {
  const finest = finestDrawn(info, triangles);
  const worthDrawing = Math.min(wanted, data + 1, info.levels);
  const level = Math.min(worthDrawing, finest);
  const [block] = info.blocks;
  const plain = info.blocks.length === 1 && !info.joined && block !== undefined;
  if (!plain || region === null || Math.min(wanted, data) <= finest) return { level, window: null };
  const wide = region.map(([from, to], axis) => {
    const more = Math.ceil((to - from) * MARGIN);
    return [Math.max(0, from - more), Math.min(block.shape[axis as 0 | 1], to + more)];
  }) as unknown as Region;
  const points = wide.reduce((product, [from, to]) => product * (to - from), 1);
  if (points > MOST_DECODED) return { level, window: null };
  let stride = 2 ** Math.max(0, info.levels - worthDrawing);
  while (points / stride ** 2 > MOST_DRAWN) stride *= 2;
  const kept = before !== null && before.stride <= stride && isInside(region, before.region);
  let around = level;
  while (around > 0 && pointsAt(info, around) > MOST_AROUND) around -= 1;
  return { level: around, window: kept ? before : { region: wide, stride } };
}

/** Whether all of a region is in another one; null: all of the surface. */
export function isInside(inner: Region | null, outer: Region): boolean {
  if (inner === null) return false;
  return [0, 1].every((axis) => {
    const [a, b] = [inner[axis as 0 | 1], outer[axis as 0 | 1]];
    return a[0] >= b[0] && a[1] <= b[1];
  });
}
