/**
 * A grid cut into patches, which are drawn at strides of powers of two: which rows and columns each draws.
 *
 * Patches of one band share its first and last row, and every patch draws its first and last row and column at every
 * stride. So corners always meet, and `stitching.ts` can join sides of different strides.
 */

/** Quads along the two axes of a grid, from its samples and closed axes. */
export function quadsOf(shape: readonly [number, number], closed: readonly [boolean, boolean]): [number, number] {
  return [0, 1].map((axis) => {
    const length = shape[axis as 0 | 1];
    return closed[axis as 0 | 1] && length > 1 ? length : length - 1;
  }) as [number, number];
}

/**
 * A rectangle of quads of one block; `rows[1]` and `columns[1]` are their last lines of nodes, not past them. Of a block
 * of a single row or column it is a piece of that line: both lines of nodes are the same.
 */
export interface Patch {
  readonly block: number;
  readonly rows: readonly [number, number];
  readonly columns: readonly [number, number];
  /** Numbers of the patches above, below, left and right; -1 where the block ends. */
  readonly beside: readonly [number, number, number, number];
}

/** No more patches than this are made of all blocks together, if their own number allows. */
const MOST_PATCHES = 1024;

/**
 * The size of patches, as a power of two: quads along each axis.
 *
 * @param quads - Of each block, along both axes.
 */
export function patchSize(quads: readonly (readonly [number, number])[]): number {
  for (let size = 32; ; size *= 2) {
    const across = (count: number): number => Math.max(1, Math.ceil(count / size));
    const count = quads.reduce((sum, [a, b]) => sum + across(a) * across(b), 0);
    if (count <= Math.max(MOST_PATCHES, quads.length) || size >= 256) return size;
  }
}

/**
 * All patches of one block.
 *
 * @param first - Number that the first one gets among the patches of all blocks.
 */
export function patchesOf(
  block: number,
  shape: readonly [number, number],
  closed: readonly [boolean, boolean],
  size: number,
  first: number,
): Patch[] {
  const quads = quadsOf(shape, closed);
  const [down, across] = quads.map((count) => Math.max(1, Math.ceil(count / size))) as [number, number];
  const number = (row: number, column: number): number => {
    if (closed[0]) row = (row + down) % down;
    if (closed[1]) column = (column + across) % across;
    return row < 0 || column < 0 || row >= down || column >= across ? -1 : first + row * across + column;
  };
  const patches: Patch[] = [];
  for (let i = 0; i < down; i += 1) {
    for (let j = 0; j < across; j += 1) {
      patches.push({
        block,
        rows: [i * size, Math.min((i + 1) * size, quads[0])],
        columns: [j * size, Math.min((j + 1) * size, quads[1])],
        beside: [number(i - 1, j), number(i + 1, j), number(i, j - 1), number(i, j + 1)],
      });
    }
  }
  return patches;
}

/** The lines that are drawn between two lines of nodes: every stride-th and the last one. */
export function linesOf([first, last]: readonly [number, number], stride: number): number[] {
  const lines: number[] = [];
  for (let k = first; k < last; k += stride) lines.push(k);
  lines.push(last);
  return lines;
}

/** Whether a patch is a piece of a line of nodes. */
export function isLine({ rows, columns }: Patch): boolean {
  return rows[0] === rows[1] || columns[0] === columns[1];
}

/**
 * What is drawn of a line of nodes.
 *
 * @param valid - [node], 0 at holes.
 * @returns the two ends of each piece; a node without neighbours is both ends of one.
 */
export function piecesOf(valid: Uint8Array): Uint32Array {
  const ends: number[] = [];
  valid.forEach((own, node) => {
    if (own === 0) return;
    if (valid[node + 1] === 1) ends.push(node, node + 1);
    else if (valid[node - 1] !== 1) ends.push(node, node);
  });
  return Uint32Array.from(ends);
}

/** Triangles of a patch at a stride, if none is left out. */
export function trianglesOf(patch: Patch, stride: number): number {
  const [down, across] = [patch.rows, patch.columns].map(([a, b]) => Math.ceil((b - a) / stride));
  return 2 * (down ?? 0) * (across ?? 0);
}
