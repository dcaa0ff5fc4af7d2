/**
 * Colour maps as tables of equally spaced stops, between which colours are interpolated linearly in sRGB.
 *
 * viridis and cividis: 17 of the 256 entries of the tables in matplotlib's `_cm_listed.py` (CC0). terrain: hypsometric tints
 * drawn up for this project.
 * red-blue: RdBu of 11 classes by C. Brewer, colorbrewer2.org (Apache License 2.0), reversed.
 */

const TABLES = {
  viridis:
    "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c 1fa088 28ae80 3fbc73 5ec962 84d44b addc30 d8e219 fde725",
  cividis:
    "00224e 002e6a 1a386f 32436d 434e6c 535a6d 61656f 6f7073 7d7c78 8c8878 9b9476 aba072 bcae6c cdbb63 dec958 f0d846 fee838",
  terrain: "2c6049 4f8356 7fa466 b0c07c d9d49a e2d19a d3b37c b8926a 9a7660 8a7468 a99c95 cfc8c3 f7f5f3",
  "red-blue": "053061 2166ac 4393c3 92c5de d1e5f0 f7f7f7 fddbc7 f4a582 d6604d b2182b 67001f",
  grey: "1a1a1a f2f2f2",
} as const;

/** Name of a colour map. */
export type ColourMapName = keyof typeof TABLES;

/** The names in the order in which they are offered. */
export const COLOUR_MAPS = Object.keys(TABLES) as ColourMapName[];

/** Whether a text is the name of a colour map. */
export function isColourMap(name: string): name is ColourMapName {
  return Object.hasOwn(TABLES, name);
}

/** The stops of a map, each red, green and blue from 0 to 255. */
export function stopsOf(name: ColourMapName): [number, number, number][] {
  return TABLES[name].split(" ").map((hex) => {
    const number = Number.parseInt(hex, 16);
    return [number >> 16, (number >> 8) & 255, number & 255];
  });
}

/**
 * The colour of a place on a map.
 *
 * @param at - 0 to 1; values outside get the colour of the nearer end.
 * @returns red, green and blue, 0 to 255, not rounded.
 */
export function colourAt(name: ColourMapName, at: number): [number, number, number] {
  const stops = stopsOf(name);
  const place = Math.min(Math.max(at, 0), 1) * (stops.length - 1);
  const below = Math.min(Math.floor(place), stops.length - 2);
  const part = place - below;
  const [a, b] = [stops[below] ?? [0, 0, 0], stops[below + 1] ?? [0, 0, 0]];
  return [0, 1, 2].map((k) => (a[k] ?? 0) * (1 - part) + (b[k] ?? 0) * part) as [number, number, number];
}

/** A map as a texture of 256 x 1 pixels, RGBA. */
export function textureOf(name: ColourMapName): Uint8Array {
  const pixels = new Uint8Array(256 * 4);
  for (let k = 0; k < 256; k += 1) {
    const [red, green, blue] = colourAt(name, k / 255);
    pixels.set([Math.round(red), Math.round(green), Math.round(blue), 255], 4 * k);
  }
  return pixels;
}

/**
 * The range that colours span by default.
 *
 * @param lowest - Smallest value; NaN where there are none.
 * @param highest - Largest value.
 * @param symmetric - For a diverging map: 0 is in the middle.
 */
export function rangeOf(lowest: number, highest: number, symmetric: boolean): [number, number] {
  if (!(lowest <= highest)) return [0, 1];
  if (symmetric) {
    const most = Math.max(Math.abs(lowest), Math.abs(highest)) || 1;
    return [-most, most];
  }
  if (lowest < highest) return [lowest, highest];
  const margin = Math.abs(lowest) / 2 || 0.5;
  return [lowest - margin, highest + margin];
}
