import { expect, it } from "vitest";
import { readIndex } from "../../src/container";
import { Decoder } from "../../src/decoding/decoder";
import { loadKernels } from "../../src/kernels/instance";
import { readWindowErrors } from "../../src/planning/window-errors";
import { localErrors } from "../../src/view/local-errors";
import type { Price } from "../../src/view/source";
import { run } from "../python";

it("errors around a node hold there, and are smaller than those of the whole somewhere", async () => {
  const [first] = run("tests.web.window_errors").trim().split("\n");
  const data = new Uint8Array(Buffer.from((JSON.parse(first!) as { container: string }).container, "base64"));
  const read = async (offset: number, length: number) => data.subarray(offset, offset + length);
  const index = await readIndex(read, data.length);
  const { header, layers } = index;
  const windows = await readWindowErrors(index, read);
  const prices: Price[] = layers.map(({ end, level, errors }) => ({
    bytes: end,
    level,
    rms: errors.rms,
    max: errors.maximum,
  }));
  const decoder = new Decoder(await loadKernels());
  decoder.feed(data);
  const exact = decoder.surface().blocks[0]!.points.values;
  const [height, width] = header.shape;
  let smaller = 0;
  for (const view of decoder.layers.slice(2, -1)) {
    const values = view.surface().blocks[0]!.points.values;
    for (let k = 0; k < 200; k += 1) {
      const [row, column] = [(k * 37) % height, (k * 91) % width];
      const node = row * width + column;
      const { max, rms, within } = localErrors(view, header, windows, prices, row, column);
      expect(Math.abs(Number(values[node]) - Number(exact[node]))).toBeLessThanOrEqual(max);
      expect(within).toEqual([row < 256 ? 256 : height - 256, column < 512 ? 256 : width - 512]);
      expect(rms).toBeLessThanOrEqual(max);
      if (max < view.maxError / 2) smaller += 1;
    }
  }
  expect(smaller).toBeGreaterThan(0);
  const view = decoder.layers[3]!;
  const whole = { rms: view.rms, max: view.maxError, within: null };
  expect(localErrors(view, header, null, prices, 0, 0)).toEqual(whole);
  // A state that is no layer, such as one of a region that came first, is not known cell by cell.
  const mixed = { number: 3, rms: Number.NaN, maxError: Number.NaN };
  expect(localErrors(mixed, header, windows, prices, 0, 0)).toEqual({ rms: Number.NaN, max: Number.NaN, within: null });
  const last = decoder.layers.at(-1)!;
  expect(localErrors(last, header, windows, prices, 0, 0)).toMatchObject({ max: 0 });
});
