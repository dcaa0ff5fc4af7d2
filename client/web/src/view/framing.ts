/** Between a surface's own coordinates and those in which it is drawn: cameras, scales, what fits into the view. */

import { fitted, type Orbit, VIEW_ANGLE } from "./camera";
import { defaultExaggeration } from "./exaggeration";
import type { Box } from "./geometry-messages";
import type { Frame } from "./lattice";
import type { SurfaceInfo } from "./source";

type Triple = readonly [number, number, number];

/** Metres of a degree of latitude, which is what the scale bar of geographic coordinates shows. */
const DEGREE = 111_320;

function triple(of: (axis: 0 | 1 | 2) => number): [number, number, number] {
  return [of(0), of(1), of(2)];
}

/** How one surface is framed. */
export class Framing {
  /** Half the drawn extent along each axis, before exaggeration. */
  readonly half: Triple;
  /** The middle of what is drawn, before exaggeration. */
  readonly centre: Triple;
  /** Half the drawn diagonal of the whole surface where what is drawn may still be smaller; else 0. */
  readonly whole: number;

  constructor(
    readonly frame: Frame,
    box: Box,
    private readonly info: SurfaceInfo,
  ) {
    const half = triple((k) => ((box[1][k] - box[0][k]) / 2) * frame.scale[k]);
    this.centre = triple((k) => ((box[0][k] + box[1][k]) / 2 - frame.origin[k]) * frame.scale[k]);
    // Of heights the range is known before any of them.
    if (info.heights) half[2] = (info.extent / 2) * frame.scale[2];
    this.half = half;
    // Where z has a scale of its own, the diagonal says nothing.
    this.whole = info.heights || frame.scale[0] !== frame.scale[2] ? 0 : (info.extent / 2) * frame.scale[0];
  }

  /** How far from 0 anything is drawn, before exaggeration. */
  get radius(): number {
    return Math.hypot(...this.centre) + 1.5 * Math.max(Math.hypot(...this.half), this.whole);
  }

  /** By how much heights are exaggerated where nobody says it. */
  get exaggeration(): number {
    return defaultExaggeration(this.half, this.info.heights);
  }

  /** Whether heights have a scale of their own, since they have another unit than x and y. */
  get isFitted(): boolean {
    const { scale } = this.frame;
    const own = this.info.geographic ? scale[1] / DEGREE : scale[1];
    return Math.abs(scale[2] - own) > 1e-9 * own;
  }

  /** Whether another frame draws coordinates elsewhere. */
  differs(frame: Frame): boolean {
    return this.frame.scale.some((scale, k) => scale !== frame.scale[k]);
  }

  /** The camera that sees all. @param aspect - Width of the view by its height. */
  home(exaggeration: number, aspect: number): Orbit {
    return this.info.heights ? this.fitted(exaggeration, aspect, -90, 42) : this.fitted(exaggeration, aspect, -60, 25);
  }

  /** Likewise, from above with y upwards. */
  above(exaggeration: number, aspect: number): Orbit {
    return this.fitted(exaggeration, aspect, -90, 89.9);
  }

  private fitted(exaggeration: number, aspect: number, azimuth: number, elevation: number): Orbit {
    const [x, y, z] = this.half;
    const [a, b, c] = this.centre;
    const orbit = fitted([x, y, z * exaggeration], this.whole, aspect, azimuth, elevation);
    return { ...orbit, target: [a, b, c * exaggeration] };
  }

  /** A point as it is drawn. */
  drawn(point: Triple, exaggeration: number): [number, number, number] {
    const { origin, scale } = this.frame;
    return triple((k) => (point[k] - origin[k]) * scale[k] * (k === 2 ? exaggeration : 1));
  }

  /** A drawn camera in the surface's coordinates; its distance in units of x. */
  toSurface(orbit: Orbit, exaggeration: number): Orbit {
    const { origin, scale } = this.frame;
    const target = triple((k) => orbit.target[k] / scale[k] / (k === 2 ? exaggeration : 1) + origin[k]);
    return { ...orbit, distance: orbit.distance / scale[0], target };
  }

  /** Undoes `toSurface`. */
  toDrawn(orbit: Orbit, exaggeration: number): Orbit {
    return { ...orbit, distance: orbit.distance * this.frame.scale[0], target: this.drawn(orbit.target, exaggeration) };
  }

  /**
   * What the scale bar shows.
   *
   * @param height - Of the view, in pixels.
   * @returns pixels of a length of 1 at the camera's target, 0 where a length means nothing, and the unit.
   */
  scale(orbit: Orbit, height: number): { pixels: number; unit: string } {
    const { geographic, planeUnit } = this.info;
    const drawn = height / (2 * orbit.distance * Math.tan((VIEW_ANGLE * Math.PI) / 360));
    // Of x, y, z whose z has a scale of its own, the unit is that of z.
    const unit = !this.info.heights && this.isFitted && planeUnit !== "°" ? "" : planeUnit;
    if (!this.info.heights && unit === "") return { pixels: 0, unit: "" };
    if (geographic) return { pixels: (drawn * this.frame.scale[1]) / DEGREE, unit: "m" };
    return { pixels: drawn * this.frame.scale[0], unit };
  }
}
