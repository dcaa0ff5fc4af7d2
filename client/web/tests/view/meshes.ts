/** Meshes of patches put together, to look for cracks. */

import type { PatchBuffers } from "../../src/view/geometry-messages";

/** The edges of a mesh whose nodes are numbered by where they are drawn. */
export interface Edges {
  /** Coordinates of each node. */
  readonly nodes: number[][];
  /** How often each edge, first * nodes.length + second, occurs in the direction of its triangle. */
  readonly count: Map<number, number>;
}

/** The directed edges of all triangles that have an area. */
export function edgesOf(patches: Iterable<PatchBuffers>, positions: (patch: PatchBuffers) => Float32Array): Edges {
  const numbers = new Map<string, number>();
  const nodes: number[][] = [];
  const triangles: number[] = [];
  for (const patch of patches) {
    const points = positions(patch);
    const own = Array.from({ length: points.length / 3 }, (_, node) => {
      const point = points.subarray(3 * node, 3 * node + 3);
      const key = point.join();
      const known = numbers.get(key);
      if (known !== undefined) return known;
      numbers.set(key, nodes.length);
      return nodes.push([...point]) - 1;
    });
    for (const node of patch.triangles) triangles.push(own[node]!);
  }
  const count = new Map<number, number>();
  for (let k = 0; k < triangles.length; k += 3) {
    const [a, b, c] = [triangles[k]!, triangles[k + 1]!, triangles[k + 2]!];
    if (a === b || b === c || a === c) continue; // no area, as at a pole
    for (const edge of [a * nodes.length + b, b * nodes.length + c, c * nodes.length + a]) {
      count.set(edge, (count.get(edge) ?? 0) + 1);
    }
  }
  return { nodes, count };
}

/** The ends of edges that have no triangle on their other side. */
export function openEdges({ nodes, count }: Edges): [number[], number[]][] {
  const open: [number[], number[]][] = [];
  for (const edge of count.keys()) {
    const [a, b] = [Math.floor(edge / nodes.length), edge % nodes.length];
    if (!count.has(b * nodes.length + a)) open.push([nodes[a]!, nodes[b]!]);
  }
  return open;
}

/** Nodes - edges + faces of a closed mesh of triangles; nodes without an edge do not count. */
export function eulerNumber({ nodes, count }: Edges): number {
  const used = new Set([...count.keys()].map((edge) => Math.floor(edge / nodes.length)));
  return used.size - count.size / 2 + count.size / 3;
}

/** The sum of the areas of triangles in the plane of two coordinates. */
export function areaOf(
  patches: Iterable<PatchBuffers>,
  x: 0 | 1 | 2 = 0,
  y: 0 | 1 | 2 = 1,
): { signed: number; unsigned: number } {
  let [signed, unsigned] = [0, 0];
  for (const { positions, triangles } of patches) {
    const at = (k: number, axis: number): number => positions[3 * triangles[k]! + axis]!;
    for (let k = 0; k < triangles.length; k += 3) {
      const [ux, uy] = [at(k + 1, x) - at(k, x), at(k + 1, y) - at(k, y)];
      const [vx, vy] = [at(k + 2, x) - at(k, x), at(k + 2, y) - at(k, y)];
      const area = (ux * vy - uy * vx) / 2;
      signed += area;
      unsigned += Math.abs(area);
    }
  }
  return { signed, unsigned };
}
