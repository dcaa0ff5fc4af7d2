/** At which stride each patch is drawn, so that its quads are about a pixel large and all triangles stay within a bound. */

import type { Eye } from "./geometry-messages";
import { type Patch, trianglesOf } from "./patches";

/** What of a patch decides its stride. */
export interface PatchBounds {
  readonly patch: Patch;
  /** Centre of the patch in drawn coordinates, before exaggeration. */
  readonly centre: readonly [number, number, number];
  /** Half the extent along each axis. */
  readonly half: readonly [number, number, number];
  /** Length of an average edge, without holes. */
  readonly edge: number;
}

/** Quads are drawn about this large, in pixels. */
const QUAD_PIXELS = 1.5;
/** Outside the view a patch may have quads so many times larger. */
const OUTSIDE = 8;

/** The strides, and what the view would like. */
export interface Strides {
  /** A power of two for each patch. */
  readonly strides: Int32Array;
  readonly triangles: number;
  /** By how many levels a finer grid would be drawn; negative: so many levels are not drawn anywhere in the view. */
  readonly finer: number;
  /** Which patches are in the view. */
  readonly seen: boolean[];
}

/**
 * Chooses the strides of all patches.
 *
 * @param most - Triangles at most; less than two a patch is not possible.
 * @param size - Largest stride: quads along a side of a patch.
 */
export function chooseStrides(bounds: readonly PatchBounds[], eye: Eye, most: number, size: number): Strides {
  const planes = frustum(eye.matrix);
  const seen: boolean[] = [];
  let finer = Number.NEGATIVE_INFINITY;
  const wished = bounds.map((of) => {
    const centre: Triple = [of.centre[0], of.centre[1], of.centre[2] * eye.exaggeration];
    const half: Triple = [of.half[0], of.half[1], of.half[2] * eye.exaggeration];
    const visible = planes.every((plane) => {
      const reach = Math.abs(plane[0]) * half[0] + Math.abs(plane[1]) * half[1] + Math.abs(plane[2]) * half[2];
      return plane[0] * centre[0] + plane[1] * centre[1] + plane[2] * centre[2] + plane[3] >= -reach;
    });
    seen.push(visible);
    const distance = Math.max(
      Math.hypot(...([0, 1, 2] as const).map((k) => Math.max(0, Math.abs(eye.position[k] - centre[k]) - half[k]))),
      1e-6,
    );
    const wish = Math.log2((QUAD_PIXELS * distance) / (Math.max(of.edge, 1e-12) * eye.focal));
    if (visible) finer = Math.max(finer, -wish - 0.5);
    return visible ? wish : wish + Math.log2(OUTSIDE);
  });
  const largest = Math.log2(size);
  for (let more = 0; ; more += 0.25) {
    let triangles = 0;
    const strides = Int32Array.from(wished, (wish, k) => {
      const stride = 2 ** Math.min(Math.max(Math.round(wish + more), 0), largest);
      triangles += trianglesOf(bounds[k]!.patch, stride);
      return stride;
    });
    if (triangles <= most || strides.every((stride) => stride === size)) {
      return { strides, triangles, finer: Number.isFinite(finer) ? Math.ceil(finer) : 0, seen };
    }
  }
}

type Triple = [number, number, number];

/** The planes around what a matrix shows (without near and far), with normals that point inwards. */
function frustum(m: readonly number[]): [number, number, number, number][] {
  const row = (k: number): number[] => [m[k]!, m[4 + k]!, m[8 + k]!, m[12 + k]!];
  const [x, y, w] = [row(0), row(1), row(3)];
  const plane = (a: number[], sign: number) =>
    w.map((value, k) => value + sign * a[k]!) as [number, number, number, number];
  return [plane(x, 1), plane(x, -1), plane(y, 1), plane(y, -1), w as [number, number, number, number]];
}
