import { describe, expect, it } from "vitest";
import { chunkPlaces, readIndex } from "../src/container";
import { checkOf } from "../src/container/crc";
import { containerOf, EXPECTED, NAMES } from "./golden";

function reading(data: Uint8Array) {
  return async (offset: number, length: number) => data.subarray(offset, offset + length);
}

describe("the index of golden containers", () => {
  it.each(NAMES)("%s says what is expected", async (name) => {
    const data = containerOf(name);
    const index = await readIndex(reading(data), data.length);
    const expected = EXPECTED[name]!;
    const layers = index.layers.map((layer) => ({
      bytes: layer.end,
      level: layer.level,
      rms: layer.errors.rms,
      max: layer.errors.maximum,
    }));
    const wanted = expected.layers.map(({ bytes, level, rms, max }) => ({ bytes, level, rms, max }));
    expect(layers).toEqual(wanted.slice(0, layers.length));
    expect(index.levels.length).toBe(expected.levels.length);
    expect(index.levels.at(-1)!.bytes).toBe(index.surfaceEnd);
    expect(index.header.blocks.map((block) => block.closed)).toEqual(expected.blocks.map((block) => block.closed));
    expect(index.header.masks.holes.length ? index.header.masks.holes : index.header.blocks.map(() => 0)).toEqual(
      expected.blocks.map((block) => block.holes),
    );
    for (const item of [...index.segments, ...index.chunks]) {
      const { offset, length } = item.range;
      if (length) expect(checkOf(data.subarray(offset, offset + length))).toBe(item.check);
    }
    if (index.residual) expect([...chunkPlaces(index.header)].length).toBe(index.chunks.length);
  });
});
