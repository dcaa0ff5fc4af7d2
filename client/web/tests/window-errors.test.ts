import { expect, it } from "vitest";
import { readIndex } from "../src/container";
import { CorruptStreamError, OptionError } from "../src/errors";
import { plan } from "../src/planning/planner";
import { makeTarget } from "../src/planning/target";
import { readWindowErrors } from "../src/planning/window-errors";
import type { Region } from "../src/types";
import { containerOf } from "./golden";
import { run } from "./python";

interface Told {
  container: string;
  mask: string | null;
  cases: { region: Region; layer: number; bounds: [number, number] }[];
}

const bytes = (text: string) => new Uint8Array(Buffer.from(text, "base64"));
const reading = (data: Uint8Array) => async (offset: number, length: number) => data.subarray(offset, offset + length);

it("bounds of errors of windows are those of the Python library", async () => {
  for (const line of run("tests.web.window_errors").trim().split("\n")) {
    const { container, mask, cases } = JSON.parse(line) as Told;
    const data = bytes(container);
    const index = await readIndex(reading(data), data.length);
    const errors = (await readWindowErrors(index, reading(data)))!;
    for (const { region, layer, bounds } of cases) {
      const { rms, maximum } = errors.bounds(region, layer, mask === null ? null : bytes(mask));
      expect(rms / (bounds[0] || 1)).toBeCloseTo(bounds[0] ? 1 : 0, 9);
      expect(maximum).toBe(bounds[1]);
    }
    expect(() => errors.bounds(cases[0]!.region, index.layers.length)).toThrow(OptionError);
    // They come behind the index, in whatever order the slices come.
    const section = index.optional[0]!.range;
    for (const first of [undefined, cases[1]!.region]) {
      const target = makeTarget({ region: cases[0]!.region, first });
      const chosen = plan(index, target, undefined, { windows: errors, bounded: true });
      expect(chosen.before).toEqual([index.index, section]);
    }
    const place = section.offset + 20;
    data[place]! ^= 1;
    await expect(readWindowErrors(index, reading(data))).rejects.toBeInstanceOf(CorruptStreamError);
  }
});

it("a container that tells none has none", async () => {
  const data = containerOf("two-points");
  const index = await readIndex(reading(data), data.length);
  expect(await readWindowErrors(index, reading(data))).toBeNull();
});
