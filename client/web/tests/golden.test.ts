import { createHash } from "node:crypto";
import { beforeAll, describe, expect, it } from "vitest";
import { Decoder } from "../src/decoding";
import { loadKernels } from "../src/kernels/instance";
import type { Surface, Values } from "../src/types";
import { containerOf, EXPECTED, NAMES } from "./golden";

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

function bytesOf(values: Values): Uint8Array {
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

describe("golden containers", () => {
  it.each(NAMES)("%s is the same bit for bit at every layer and level", (name) => {
    const expected = EXPECTED[name]!;
    const decoder = new Decoder(kernels);
    decoder.feed(containerOf(name));
    decoder.finish();
    const layers = decoder.layers.map((view) => ({
      bytes: view.bytes,
      level: view.level,
      rms: view.rms,
      max: view.maxError,
      sha256: digests(view.surface()),
    }));
    expect(layers).toEqual(expected.layers);
    const header = decoder.header!;
    const levels = Array.from({ length: header.levels + 1 }, (_, level) =>
      digests(decoder.surface(level), header.plane !== null && level < header.levels),
    );
    expect(levels).toEqual(expected.levels);
    const blocks = decoder.surface().blocks.map((block) => ({
      closed: block.closed,
      holes: block.mask ? block.mask.filter((valid) => !valid).length : 0,
      points: kindOf(block.shape, block.points),
      attributes: Object.fromEntries([...block.attributes].map(([key, array]) => [key, kindOf(block.shape, array)])),
    }));
    expect(blocks).toEqual(expected.blocks);
  });
});

function kindOf(shape: readonly number[], array: { dtype: string; flat: boolean; components: number }) {
  return { type: array.dtype, shape: array.flat ? [...shape] : [...shape, array.components] };
}
