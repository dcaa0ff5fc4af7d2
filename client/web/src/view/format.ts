/** Numbers as text. */

/** Bytes in decimal units with three digits: 812 B, 34.1 kB, 1.20 MB. */
export function formatBytes(bytes: number): string {
  if (bytes < 1000) return `${Math.round(bytes)} B`;
  const units = ["kB", "MB", "GB", "TB"];
  let unit = -1;
  do {
    bytes /= 1000;
    unit += 1;
  } while (bytes >= 999.5 && unit < units.length - 1);
  return `${bytes.toPrecision(3)} ${units[unit]}`;
}

/** A number with a few significant digits, without an exponent where that is short. */
export function formatNumber(value: number, digits = 4): string {
  if (Number.isNaN(value)) return "unknown";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 10 ** Math.max(digits + 3, 7) || size < 1e-4)
    return value.toExponential(Math.max(digits - 2, 1)).replace("e+", "e");
  const places = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return String(Number(value.toFixed(Math.min(places, 20))));
}

/** A number with all digits that differ from its neighbours by no more than a step. */
export function formatAt(value: number, step: number): string {
  if (!Number.isFinite(value)) return "none";
  const places = step > 0 ? Math.min(Math.max(Math.ceil(-Math.log10(step)) + 1, 0), 12) : 6;
  return value.toFixed(places);
}

/** A number with the digits that matter in a range: about three of the range's length. */
export function formatWithin(value: number, [low, high]: readonly [number, number]): string {
  const length = high - low;
  if (!(length > 0) || length >= 1e7 || length < 1e-6) return formatNumber(value, 4);
  const places = Math.min(Math.max(2 - Math.floor(Math.log10(length)), 0), 12);
  return String(Number(value.toFixed(places))).replace(/^-0$/, "0");
}

/** A number as it was stored: with the fewest digits that give the same float32, where it is one, and no more than 10. */
export function formatStored(value: number): string {
  if (Math.fround(value) !== value) return formatNumber(value, 10);
  for (let digits = 1; digits < 9; digits += 1) {
    if (Math.fround(Number(value.toPrecision(digits))) === value) return formatNumber(value, digits);
  }
  return formatNumber(value, 10);
}

/** Seconds as text: 0.42 s, 12 s, 3 min 20 s. */
export function formatSeconds(seconds: number): string {
  if (seconds < 10) return `${seconds.toFixed(2)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
}

/** The largest of 1, 2, 5 times a power of ten that is not above a value. */
export function roundBelow(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  const digit = value / power;
  return power * (digit >= 5 ? 5 : digit >= 2 ? 2 : 1);
}
