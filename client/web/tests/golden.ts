/** The containers of tests/golden and what is expected of them. */
import { readFileSync } from "node:fs";
import { join, resolve } from "node:path";

export const ROOT = resolve(import.meta.dirname ?? ".", "../../..");
const FOLDER = join(ROOT, "tests/golden");

interface ExpectedArray {
  type: string;
  shape: number[];
}

export interface Expected {
  blocks: {
    closed: [boolean, boolean];
    holes: number;
    points: ExpectedArray;
    attributes: Record<string, ExpectedArray>;
  }[];
  layers: { bytes: number; level: number; rms: number; max: number; sha256: string[] }[];
  levels: string[][];
}

export const EXPECTED = JSON.parse(readFileSync(join(FOLDER, "expected.json"), "utf8")) as Record<string, Expected>;
export const NAMES = Object.keys(EXPECTED).sort();

export function containerOf(name: string): Uint8Array {
  return new Uint8Array(readFileSync(join(FOLDER, `${name}.lode`)));
}
