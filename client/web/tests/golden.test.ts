import { beforeAll, describe, expect, it } from "vitest";
import { Decoder } from "../src/decoding";
import { loadKernels } from "../src/kernels/instance";
import { containerOf, digests, EXPECTED, NAMES } from "./golden";

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

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
