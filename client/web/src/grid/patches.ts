/** Blocks cut into patches: where the nodes of patches stand in their blocks, at any level (docs/format.md, section 4). */
import type { Shape } from "../types";
import { hasTail } from "./axis";
import type { Layout } from "./layout";
import type { Patch } from "./multiblock";

/** A patch with its number among those of all blocks. */
export interface NumberedPatch {
  readonly number: number;
  readonly patch: Patch;
}

/** Rows and columns of a block. */
export type Positions = readonly [rows: Int32Array, columns: Int32Array];

/** The patches of each of so many blocks. */
export function patchesByBlock(patches: readonly Patch[], count: number): NumberedPatch[][] {
  const found: NumberedPatch[][] = Array.from({ length: count }, () => []);
  patches.forEach((patch, number) => {
    found[patch.block]!.push({ number, patch });
  });
  return found;
}

/** Whether a patch is its block as it is, perhaps turned round. */
export function isWhole(patch: Patch, shape: Shape): boolean {
  const { rows, columns } = patch;
  return rows[0] === 0 && rows[1] === shape[0] && columns[0] === 0 && columns[1] === shape[1];
}

/** Which samples of a grid's axis stand at the nodes of a level. */
function nodePositions(layout: Layout, grid: number, axis: number, level: number): Int32Array {
  const length = layout.grids[grid]!.shape[axis]!;
  let positions: Int32Array = Int32Array.from({ length }, (_, i) => i);
  for (let finer = layout.levels; finer > level; finer--) {
    const step = layout.steps(grid, finer)[axis]!;
    if (!step.midpoints) continue;
    const nodes = new Int32Array(step.coarse);
    for (let i = 0; i < step.run; i++) nodes[i] = positions[2 * i]!;
    if (hasTail(step)) nodes[step.coarse - 1] = positions[positions.length - 1]!;
    positions = nodes;
  }
  return positions;
}

/** Which rows and columns of its block, of this shape, the nodes of a patch stand at, in the order of the patch's grid. */
export function patchPositions(
  own: NumberedPatch,
  patches: number,
  layout: Layout,
  level: number,
  shape: Shape,
): Positions {
  const grid = layout.grids.length - patches + own.number;
  const [rows, columns] = [own.patch.rows, own.patch.columns].map((window, axis) => {
    const nodes = nodePositions(layout, grid, axis, level);
    const last = layout.grids[grid]!.shape[axis]! - 1;
    const flipped = own.patch.flipped[axis];
    // Along closed axes windows go on from the last sample to the first.
    return nodes.map((node) => (window[0] + (flipped ? last - node : node)) % shape[axis]!);
  });
  return [rows!, columns!];
}

/** Which rows and columns of a block of this shape, whose patches are `own`, stand at a level's nodes, increasing. */
export function levelPositions(
  own: readonly NumberedPatch[],
  patches: number,
  layout: Layout,
  level: number,
  shape: Shape,
): Positions {
  const seen = [new Uint8Array(shape[0]), new Uint8Array(shape[1])];
  for (const patch of own) {
    patchPositions(patch, patches, layout, level, shape).forEach((positions, axis) => {
      for (const position of positions) seen[axis]![position] = 1;
    });
  }
  const [rows, columns] = seen.map((marks) => {
    const found = new Int32Array(marks.reduce((sum, mark) => sum + mark, 0));
    let count = 0;
    marks.forEach((mark, position) => {
      if (mark) found[count++] = position;
    });
    return found;
  });
  return [rows!, columns!];
}

/** Rows and columns of each block's grid at a level; `shapes` are the blocks'. */
export function levelShapes(
  patches: readonly Patch[],
  layout: Layout,
  level: number,
  shapes: readonly Shape[],
): Shape[] {
  if (patches.length === shapes.length && patches.every((patch) => isWhole(patch, shapes[patch.block]!))) {
    const interfaces = layout.grids.length - patches.length;
    return shapes.map((_, number) => layout.shape(interfaces + number, level));
  }
  return patchesByBlock(patches, shapes.length).map((own, block): Shape => {
    const [rows, columns] = levelPositions(own, patches.length, layout, level, shapes[block]!);
    return [rows.length, columns.length];
  });
}
