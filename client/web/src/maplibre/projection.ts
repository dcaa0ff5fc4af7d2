/** A coordinate reference system: from longitudes and latitudes to its x and y and back. */

import { readCrs } from "./wkt";

/** Of the sphere of Web Mercator, and the larger half axis of WGS 84; in metres. */
export const EARTH_RADIUS = 6378137;

const DEGREE = Math.PI / 180;

/** Degrees of a full turn. */
const TURN = 360;

/**
 * Turns places x, y, x, y, ... of longitudes and latitudes into ones of a CRS, or back. Where there are none, NaN or
 * infinite.
 */
export type Transform = (places: Float64Array, back: boolean) => Promise<Float64Array>;

/** Transforms of CRS that are not built in. `name`: for people. */
export type ForeignTransform = (crs: ForeignCrs, places: Float64Array, back: boolean) => Promise<Float64Array>;

/** A CRS that a library of projections has to know. */
export interface ForeignCrs {
  readonly wkt: string;
  readonly name: string;
  readonly code: string | undefined;
}

/** The horizontal part of a CRS, and the unit of its heights. */
export interface Projection {
  readonly transform: Transform;
  /** What x repeats after; undefined: it does not. x and y are then longitudes and latitudes. */
  readonly turn: number | undefined;
  /** Metres upwards of one unit of a compound CRS's heights, negative for depths; undefined: it has no vertical axis. */
  readonly vertical: number | undefined;
}

const BUILT_IN: Readonly<Record<string, Transform>> = {
  "EPSG:4326": same,
  "EPSG:4979": same,
  "OGC:CRS84": same,
  "EPSG:3857": mercator,
};

/**
 * The projection of a WKT.
 *
 * @throws InputError if it cannot be understood, or is not on the Earth's surface.
 */
export function projectionOf(wkt: string, foreign: ForeignTransform): Projection {
  const { flat, name, code, degrees, vertical } = readCrs(wkt);
  const built = code === undefined ? undefined : BUILT_IN[code];
  const transform = built ?? ((places, back) => foreign({ wkt: flat, name, code }, places, back));
  return { transform, turn: degrees ? TURN : undefined, vertical };
}

async function same(places: Float64Array): Promise<Float64Array> {
  return places;
}

async function mercator(places: Float64Array, back: boolean): Promise<Float64Array> {
  const found = new Float64Array(places.length);
  for (let i = 0; i < places.length; i += 2) {
    const [x, y] = [places[i]!, places[i + 1]!];
    found[i] = back ? x / EARTH_RADIUS / DEGREE : x * DEGREE * EARTH_RADIUS;
    found[i + 1] = back
      ? Math.atan(Math.sinh(y / EARTH_RADIUS)) / DEGREE
      : Math.asinh(Math.tan(y * DEGREE)) * EARTH_RADIUS;
  }
  return found;
}
