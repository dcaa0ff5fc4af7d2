/** The containers of tests/golden and what is expected of them. */
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { join, resolve } from "node:path";
import type { Surface, Values } from "../src/types";

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
  /** Of some files: the errors of channels after each layer, and the coarser levels of each layer. */
  channels?: number[][][];
  partial?: string[][][];
}

export const EXPECTED = JSON.parse(readFileSync(join(FOLDER, "expected.json"), "utf8")) as Record<string, Expected>;
export const NAMES = Object.keys(EXPECTED).sort();

export function containerOf(name: string): Uint8Array {
  return new Uint8Array(readFileSync(join(FOLDER, `${name}.lode`)));
}

export function bytesOf(values: Values): Uint8Array {
  return new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
}

/** Of each block, the digest of its points (or of z alone) and then its attributes. */
export function digests(surface: Surface, heights = false): string[] {
  return surface.blocks.map(({ points, attributes }) => {
    const hash = createHash("sha256");
    const size = points.values.BYTES_PER_ELEMENT;
    const bytes = bytesOf(points.values);
    if (heights) for (let at = 2 * size; at < bytes.length; at += 3 * size) hash.update(bytes.subarray(at, at + size));
    else hash.update(bytes);
    for (const { values } of attributes.values()) hash.update(bytesOf(values));
    return hash.digest("hex").slice(0, 20);
  });
}
