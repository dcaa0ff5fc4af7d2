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

/** Share of the view that is filled by what is to be seen whole. */
const FILLED = 0.9;

/**
 * The camera at given angles that sees a whole box around 0 and is as near as that allows.
 *
 * @param half - Half the extent of the box.
 * @param whole - Half the diagonal of the whole surface, where the box may be that of a coarser one; else 0.
 * @param aspect - Width of the view by its height.
 */
export function fitted(half: Triple, whole: number, aspect: number, azimuth: number, elevation: number): Orbit {
  const [a, e] = [azimuth * RADIANS, elevation * RADIANS];
  const axes: readonly Triple[] = [
    [-Math.sin(a), Math.cos(a), 0],
    [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)],
    [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)],
  ];
  const high = FILLED * Math.tan((VIEW_ANGLE / 2) * RADIANS);
  const larger = Math.max(1, whole / (Math.hypot(...half) || Number.POSITIVE_INFINITY));
  let distance = 0;
  for (let corner = 0; corner < 8; corner += 1) {
    const [right, up, near] = axes.map((axis) =>
      axis.reduce((sum, part, k) => sum + part * half[k as 0 | 1 | 2] * (corner & (1 << k) ? larger : -larger), 0),
    ) as [number, number, number];
    distance = Math.max(distance, near + Math.abs(right) / (high * aspect), near + Math.abs(up) / high);
  }
  if (!(distance > 0)) distance = (whole || 1) / high;
  return { azimuth, elevation, distance, target: [0, 0, 0] };
}

/** Whether two cameras with the same angles show about the same, so that moving from one to the other is not worth it. */
export function nearly(a: Orbit, b: Orbit): boolean {
  const apart = Math.hypot(...([0, 1, 2] as const).map((k) => a.target[k] - b.target[k]));
  const farther = Math.max(a.distance, b.distance);
  return apart <= 0.015 * farther && Math.abs(a.distance - b.distance) <= 0.03 * farther;
}

/** The camera at a share of the way from one to another. */
export function blended(from: Orbit, to: Orbit, share: number): Orbit {
  const mix = (a: number, b: number): number => a + (b - a) * share;
  return {
    azimuth: wrapped(from.azimuth + wrapped(to.azimuth - from.azimuth) * share),
    elevation: mix(from.elevation, to.elevation),
    distance: from.distance * (to.distance / from.distance) ** share,
    target: ([0, 1, 2] as const).map((k) => mix(from.target[k], to.target[k])) as [number, number, number],
  };
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
