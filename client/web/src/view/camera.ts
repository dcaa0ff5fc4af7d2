/** The camera: an orbit around a point, in drawn coordinates (z is up). Pure functions of its state. */

/** Where the camera is. Angles are in degrees. */
export interface Orbit {
  /** Direction from the target to the camera: 0 is along x, 90 along y. */
  readonly azimuth: number;
  /** Of the camera above the target, -89.9 to 89.9. */
  readonly elevation: number;
  readonly distance: number;
  readonly target: readonly [number, number, number];
}

/** Height of the view, in degrees. */
export const VIEW_ANGLE = 35;
const STEEPEST = 89.9;
const RADIANS = Math.PI / 180;

type Triple = readonly [number, number, number];

/** The camera's place. */
export function positionOf({ azimuth, elevation, distance, target }: Orbit): [number, number, number] {
  const [a, e] = [azimuth * RADIANS, elevation * RADIANS];
  return [
    target[0] + distance * Math.cos(e) * Math.cos(a),
    target[1] + distance * Math.cos(e) * Math.sin(a),
    target[2] + distance * Math.sin(e),
  ];
}

/**
 * The camera that sees a whole box.
 *
 * @param half - Half the extent of the box around 0.
 * @param whole - Half the diagonal of the whole surface, where the box may be that of a coarser one; else 0.
 * @param aspect - Width of the view by its height.
 * @param flat - A height field: seen from the south and above.
 */
export function fitted(half: Triple, whole: number, aspect: number, flat: boolean): Orbit {
  const radius = Math.max(Math.hypot(...half), whole) || 1;
  const narrow = Math.min(1, aspect);
  const distance = (radius / Math.sin((VIEW_ANGLE / 2) * RADIANS) / narrow) * (flat ? 0.8 : 0.82);
  return { azimuth: flat ? -90 : -60, elevation: flat ? 42 : 25, distance, target: [0, 0, 0] };
}

/** Turns around the target. */
export function turned(orbit: Orbit, azimuth: number, elevation: number): Orbit {
  return {
    ...orbit,
    azimuth: wrapped(orbit.azimuth + azimuth),
    elevation: Math.min(Math.max(orbit.elevation + elevation, -STEEPEST), STEEPEST),
  };
}

/** The angle of the same direction from -180 to below 180. */
export function wrapped(angle: number): number {
  return ((((angle + 180) % 360) + 360) % 360) - 180;
}

/**
 * Moves the target in the plane of the view.
 *
 * @param right - Shares of the height of what is seen at the target.
 * @param up - Likewise.
 */
export function panned(orbit: Orbit, right: number, up: number): Orbit {
  const [a, e] = [orbit.azimuth * RADIANS, orbit.elevation * RADIANS];
  const height = 2 * orbit.distance * Math.tan((VIEW_ANGLE / 2) * RADIANS);
  const [x, y] = [right * height, up * height];
  const [t0, t1, t2] = orbit.target;
  return {
    ...orbit,
    target: [
      t0 - x * Math.sin(a) - y * Math.sin(e) * Math.cos(a),
      t1 + x * Math.cos(a) - y * Math.sin(e) * Math.sin(a),
      t2 + y * Math.cos(e),
    ],
  };
}

/**
 * Moves nearer or away.
 *
 * @param factor - Of the distance.
 * @param towards - A point that keeps its place on the screen; null: the target.
 */
export function zoomed(orbit: Orbit, factor: number, towards: Triple | null = null): Orbit {
  const distance = Math.min(Math.max(orbit.distance * factor, 1e-5), 50);
  const by = 1 - distance / orbit.distance;
  const target = orbit.target.map((value, k) =>
    towards === null ? value : value + by * ((towards[k as 0 | 1 | 2] ?? value) - value),
  ) as unknown as Triple;
  return { ...orbit, distance, target };
}

/** Distances of the planes between which everything within a radius of 0 is drawn. */
export function clipping(orbit: Orbit, radius: number): [number, number] {
  const far = Math.hypot(...positionOf(orbit)) + radius;
  const near = Math.max(Math.hypot(...positionOf(orbit)) - radius, orbit.distance * 0.02, far * 1e-5);
  return [near * 0.9, far * 1.1];
}
