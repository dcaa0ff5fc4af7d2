/** Heights as colours. */

import { rint } from "../coordinates/coordinate-rules";

/** Whole numbers of steps above a base, in metres: `encoding` is what MapLibre calls it. */
const CODES = {
  "terrain-rgb": { base: 10000, steps: 10, encoding: "mapbox" },
  terrarium: { base: 32768, steps: 256, encoding: "terrarium" },
} as const;

/** How heights become colours. */
export type Encoding = keyof typeof CODES;

/** All of them. */
export const ENCODINGS = Object.keys(CODES) as Encoding[];

/** What MapLibre calls an encoding. */
export function mapLibreName(encoding: Encoding): string {
  return CODES[encoding].encoding;
}

/**
 * Heights in metres as pixels red, green, blue and 255; where there are none, `nodata`. Never 0, 0, 0, which clients take
 * for a depth of many kilometres.
 */
export function coloured(heights: Float32Array, encoding: Encoding, nodata: number): Uint8ClampedArray<ArrayBuffer> {
  const { base, steps } = CODES[encoding];
  const pixels = new Uint8ClampedArray(4 * heights.length);
  // Holes have the precision of heights, as in tiles of the Python library.
  const hole = Math.fround(nodata);
  for (let i = 0; i < heights.length; i++) {
    const metres = Number.isFinite(heights[i]!) ? heights[i]! : hole;
    const code = Math.min(Math.max(rint((metres + base) * steps), 1), 2 ** 24 - 1);
    pixels[4 * i] = code >> 16;
    pixels[4 * i + 1] = (code >> 8) & 255;
    pixels[4 * i + 2] = code & 255;
    pixels[4 * i + 3] = 255;
  }
  return pixels;
}
