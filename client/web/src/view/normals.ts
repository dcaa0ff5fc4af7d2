/** Normals of nodes: the sum of the normals of the quads around a node, weighted by their areas. */

import type { Lattice } from "./lattice";

/**
 * Normals of the inner nodes of a lattice; its outermost lines only take part.
 *
 * @returns [row - 2, column - 2, xyz], not normalised: twice the area of the quads beside the node that have no hole;
 * 0 where there is none.
 */
export function normalSums(lattice: Lattice): Float64Array {
  const { rows, columns, points, valid } = lattice;
  const width = columns - 1;
  const faces = new Float64Array((rows - 1) * width * 3);
  for (let i = 0; i + 1 < rows; i += 1) {
    for (let j = 0; j + 1 < columns; j += 1) {
      const [a, b] = [i * columns + j, i * columns + j + 1];
      const [c, d] = [a + columns, b + columns];
      if (valid[a] === 0 || valid[b] === 0 || valid[c] === 0 || valid[d] === 0) continue;
      cross(points, 3 * a, 3 * b, 3 * c, 3 * d, faces, 3 * (i * width + j));
    }
  }
  const sums = new Float64Array((rows - 2) * (columns - 2) * 3);
  for (let i = 1; i + 1 < rows; i += 1) {
    for (let j = 1; j + 1 < columns; j += 1) {
      const to = 3 * ((i - 1) * (columns - 2) + j - 1);
      const from = 3 * ((i - 1) * width + j - 1);
      for (let k = 0; k < 3; k += 1) {
        sums[to + k] =
          faces[from + k]! + faces[from + 3 + k]! + faces[from + 3 * width + k]! + faces[from + 3 * width + 3 + k]!;
      }
    }
  }
  return sums;
}

/** The normal of a quad from its diagonals a-d and b-c; its length is twice the area of a plane quad. */
function cross(p: Float64Array, a: number, b: number, c: number, d: number, out: Float64Array, at: number): void {
  const at3 = (k: number): number => p[k]!;
  const [ux, uy, uz] = [at3(d) - at3(a), at3(d + 1) - at3(a + 1), at3(d + 2) - at3(a + 2)];
  const [vx, vy, vz] = [at3(c) - at3(b), at3(c + 1) - at3(b + 1), at3(c + 2) - at3(b + 2)];
  out[at] = uy * vz - uz * vy;
  out[at + 1] = uz * vx - ux * vz;
  out[at + 2] = ux * vy - uy * vx;
}

/**
 * Normals as the graphics card takes them.
 *
 * @param sums - [node, xyz] of any length.
 * @param line - Of nodes of a line, which has none.
 * @returns [node, xyz and whether it is a line], each from -127 to 127; upwards where the sum is 0.
 */
export function packedNormals(sums: Float64Array, line = false): Int8Array {
  const packed = new Int8Array((sums.length / 3) * 4);
  for (let node = 0; 3 * node < sums.length; node += 1) {
    const [x, y, z] = [sums[3 * node]!, sums[3 * node + 1]!, sums[3 * node + 2]!];
    const length = Math.hypot(x, y, z);
    packed[4 * node] = length > 0 ? Math.round((127 * x) / length) : 0;
    packed[4 * node + 1] = length > 0 ? Math.round((127 * y) / length) : 0;
    packed[4 * node + 3] = line ? 127 : 0;
    packed[4 * node + 2] = length > 0 ? Math.round((127 * z) / length) : 127;
  }
  return packed;
}

/**
 * The slope at each node in degrees, 0 to 90: the angle between the normal of the surface and the vertical.
 *
 * @param sums - Of what is drawn.
 * @param rise - By how much z are drawn higher than x and y of the same length.
 */
export function slopes(sums: Float64Array, rise: number): Float64Array {
  const result = new Float64Array(sums.length / 3);
  for (let node = 0; node < result.length; node += 1) {
    const [x, y, z] = [sums[3 * node]!, sums[3 * node + 1]!, sums[3 * node + 2]!];
    result[node] =
      x === 0 && y === 0 && z === 0 ? Number.NaN : (Math.atan2(Math.hypot(x, y), Math.abs(z) * rise) * 180) / Math.PI;
  }
  return result;
}
