/** The triangles of a patch, joined without cracks to neighbours that are drawn at coarser strides. */

import { linesOf, type Patch } from "./patches";

/** Strides of the patches above, below, left and right; 0 where the block ends. */
export type StridesBeside = readonly [number, number, number, number];

/**
 * Triangles of a patch.
 *
 * On a side whose neighbour has a larger stride, each node that the neighbour does not draw is replaced by the last one
 * before it that the neighbour draws, so both have the same edges there. What becomes degenerate is left out.
 *
 * @param stride - Of this patch.
 * @param valid - [row, column] of the drawn nodes, 0 at holes; null: all are valid. A triangle that touches a hole is
 * left out.
 * @returns three indices a triangle, into the drawn nodes in row order.
 */
export function stitched(patch: Patch, stride: number, beside: StridesBeside, valid: Uint8Array | null): Uint32Array {
  const rows = linesOf(patch.rows, stride).length;
  const columns = linesOf(patch.columns, stride).length;
  const [above, below, left, right] = beside.map((other) => Math.max(1, other / stride)) as [
    number,
    number,
    number,
    number,
  ];
  // Where a node of the drawn lattice ends up; lines before the last one lie a stride apart.
  const place = (i: number, j: number): number => {
    if (i === 0 && j < columns - 1) j -= j % above;
    else if (i === rows - 1 && j < columns - 1) j -= j % below;
    if (j === 0 && i < rows - 1) i -= i % left;
    else if (j === columns - 1 && i < rows - 1) i -= i % right;
    return i * columns + j;
  };
  const triangles = new Uint32Array(6 * (rows - 1) * (columns - 1));
  let length = 0;
  const add = (a: number, b: number, c: number): void => {
    if (a === b || b === c || a === c) return;
    if (valid !== null && (valid[a] === 0 || valid[b] === 0 || valid[c] === 0)) return;
    triangles[length] = a;
    triangles[length + 1] = b;
    triangles[length + 2] = c;
    length += 3;
  };
  for (let i = 0; i + 1 < rows; i += 1) {
    for (let j = 0; j + 1 < columns; j += 1) {
      const inside = i > 0 && j > 0 && i + 2 < rows && j + 2 < columns;
      const at = i * columns + j;
      const [a, b, c, d] = inside
        ? [at, at + 1, at + columns, at + columns + 1]
        : [place(i, j), place(i, j + 1), place(i + 1, j), place(i + 1, j + 1)];
      add(a, b, d);
      add(a, d, c);
    }
  }
  return triangles.slice(0, length);
}
