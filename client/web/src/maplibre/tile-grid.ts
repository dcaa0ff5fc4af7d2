/** Where the pixels of tiles of Web Mercator lie. */

import { OptionError } from "../errors";
import { EARTH_RADIUS } from "./projection";

/** No map has a finer zoom. */
export const FINEST_ZOOM = 30;

/** Degrees at which Web Mercator ends. */
export const LATITUDE_LIMIT = (Math.atan(Math.sinh(Math.PI)) * 180) / Math.PI;

/** West, south, east and north in degrees; east is beyond 180 where it crosses the dateline. */
export type Box = readonly [west: number, south: number, east: number, north: number];

/** Numbers of a tile; `y` counts from the north. */
export interface Tile {
  readonly z: number;
  readonly x: number;
  readonly y: number;
}

/** Longitudes and latitudes in degrees at the columns and rows of a tile, and the metres from one to the next. */
export interface TileGrid {
  readonly longitudes: Float64Array;
  readonly latitudes: Float64Array;
  readonly metres: number;
}

/**
 * The centres of the pixels of a tile, `size` along an edge; row 0 is the northernmost.
 *
 * @throws OptionError if there is no such tile.
 */
export function tileGrid({ z, x, y }: Tile, size: number): TileGrid {
  if (z > FINEST_ZOOM) throw new OptionError(`expected a zoom of 0 to ${FINEST_ZOOM}, got ${z}`);
  const tiles = 2 ** z;
  if (x >= tiles || y >= tiles) {
    throw new OptionError(`expected a tile of zoom ${z} of x and y to ${tiles - 1}, got ${x}, ${y}`);
  }
  const pixels = size * tiles;
  const longitudes = Float64Array.from({ length: size }, (_, i) => (x * size + i + 0.5) * (360 / pixels) - 180);
  const latitudes = Float64Array.from({ length: size }, (_, i) => {
    const north = Math.PI - (y * size + i + 0.5) * ((2 * Math.PI) / pixels);
    return Math.atan(Math.sinh(north)) * (180 / Math.PI);
  });
  const middle = Math.PI - (y + 0.5) * ((2 * Math.PI) / tiles);
  // The inverse of the hyperbolic cosine is the cosine of the latitude.
  return { longitudes, latitudes, metres: (2 * Math.PI * EARTH_RADIUS) / pixels / Math.cosh(middle) };
}
