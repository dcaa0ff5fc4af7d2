/**
 * How much of a picture changes, and an estimate of how much of it will still change.
 *
 * Colours differ visibly where their distance is above 5 in CIE 1976 L*a*b* (CIE 15:2018, section 8.2.1, D65).
 */

/** Distance of colours from which on they are told apart beside each other. */
export const VISIBLE = 5;

/** Bins of an octave, and the lower end of the first one: far below a step of 8 bits. */
const BINS_OF_OCTAVE = 4;
const LEAST = 2 ** -4;
const BINS = 48;

/** How far the colours of pixels are apart in two pictures of the same view. */
export interface PictureChange {
  /** Pixels that are drawn in either. */
  readonly drawn: number;
  /** Pixels by distance: bin k begins at LEAST 2^(k / 4), the first at 0; the last has those drawn in one picture only. */
  readonly bins: Uint32Array;
}

/**
 * Compares two pictures.
 *
 * @param before - Red, green, blue, alpha from 0 to 255 of each pixel (sRGB); alpha is 0 where nothing is drawn.
 * @param now - Likewise, of the same size.
 */
export function pictureChange(before: Uint8Array, now: Uint8Array): PictureChange {
  const bins = new Uint32Array(BINS);
  const [a, b] = [new Float64Array(3), new Float64Array(3)];
  let drawn = 0;
  for (let k = 0; k < now.length; k += 4) {
    const [was, is] = [before[k + 3] !== 0, now[k + 3] !== 0];
    if (!was && !is) continue;
    drawn += 1;
    if (was !== is) {
      bins[BINS - 1]! += 1;
      continue;
    }
    const same = before[k] === now[k] && before[k + 1] === now[k + 1] && before[k + 2] === now[k + 2];
    if (!same) {
      toLab(before, k, a);
      toLab(now, k, b);
    }
    const distance = same ? 0 : Math.hypot(a[0]! - b[0]!, a[1]! - b[1]!, a[2]! - b[2]!);
    bins[binOf(distance)]! += 1;
  }
  return { drawn, bins };
}

function binOf(distance: number): number {
  if (distance <= LEAST) return 0;
  return Math.min(BINS - 2, Math.floor(BINS_OF_OCTAVE * Math.log2(distance / LEAST)));
}

/** Share of the drawn pixels whose colours are further apart than a distance. */
export function shareAbove({ drawn, bins }: PictureChange, distance: number): number {
  if (drawn === 0) return 0;
  const first = binOf(distance);
  // Within a bin pixels are taken to be spread evenly over the logarithm.
  const within = Math.min(Math.max(BINS_OF_OCTAVE * Math.log2(distance / LEAST) - first, 0), 1);
  let pixels = (1 - within) * bins[first]!;
  for (let k = first + 1; k < BINS; k += 1) pixels += bins[k]!;
  return pixels / drawn;
}

/** Linear light of the 256 values of sRGB (IEC 61966-2-1). */
const LINEAR = Float64Array.from({ length: 256 }, (_, k) => {
  const value = k / 255;
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
});

const EPSILON = 216 / 24389;
const KAPPA = 24389 / 27;

function lightness(share: number): number {
  return share > EPSILON ? Math.cbrt(share) : (KAPPA * share + 16) / 116;
}

/** Sets L*, a*, b* of the pixel at `at`. */
function toLab(pixels: Uint8Array, at: number, lab: Float64Array): void {
  const [red, green, blue] = [LINEAR[pixels[at]!]!, LINEAR[pixels[at + 1]!]!, LINEAR[pixels[at + 2]!]!];
  const x = lightness((0.4124564 * red + 0.3575761 * green + 0.1804375 * blue) / 0.95047);
  const y = lightness(0.2126729 * red + 0.7151522 * green + 0.072175 * blue);
  const z = lightness((0.0193339 * red + 0.119192 * green + 0.9503041 * blue) / 1.08883);
  lab[0] = 116 * y - 16;
  lab[1] = 500 * (x - y);
  lab[2] = 200 * (y - z);
}
