import { writeSync } from "node:fs";
import { beforeAll, describe, expect, it } from "vitest";
import { Decoder, type View } from "../src/decoding";
import { loadKernels } from "../src/kernels/instance";
import type { Region } from "../src/types";
import { expectations, figures } from "./decoded";
import { digests, type Expected } from "./golden";
import { run } from "./python";

/** Surfaces that are compared: `LODESTREAM_SURFACES=2000` for all that is promised. */
const COUNT = Number(process.env.LODESTREAM_SURFACES ?? 48);
const SEED = Number(process.env.LODESTREAM_SEED ?? 1);
const AT_ONCE = 24;

interface Case {
  container: string;
  expected: Expected;
  window: { region: Region; level: number; layer: number; sha256: string[]; metadata: object } | null;
  followed: Followed;
  followed_window: (Followed & { region: Region; level: number }) | null;
}

interface Followed {
  slices: [number, number][];
  pieces: number;
  views: (number | null)[][];
  complete: boolean;
  sha256: string[][];
}

let kernels: WebAssembly.Module;
beforeAll(async () => {
  kernels = await loadKernels();
});

describe("random surfaces", () => {
  const starts = Array.from({ length: Math.ceil(COUNT / AT_ONCE) }, (_, i) => SEED + i * AT_ONCE);
  it.each(starts)(`are what Python decodes: ${AT_ONCE} from %i on`, (start) => {
    const began = performance.now();
    const count = Math.min(AT_ONCE, SEED + COUNT - start);
    const lines = run("tests.web.surfaces", start, count).trim().split("\n");
    expect(lines.length).toBe(count);
    const made = performance.now();
    let slowest = { seconds: 0, number: start };
    for (const [i, line] of lines.entries()) {
      const used = process.cpuUsage();
      check(JSON.parse(line) as Case, `surface ${start + i}`);
      const { user, system } = process.cpuUsage(used);
      const seconds = (user + system) / 1e6;
      if (seconds > slowest.seconds) slowest = { seconds, number: start + i };
    }
    // Straight to the terminal: vitest keeps what tests print until their file ends.
    writeSync(
      2,
      `surfaces to ${start + count - SEED} of ${COUNT}: ${((made - began) / 1000).toFixed(1)} s in Python, ` +
        `${((performance.now() - made) / 1000).toFixed(1)} s here; ` +
        `most processor time ${slowest.seconds.toFixed(2)} s, surface ${slowest.number}\n`,
    );
  });
});

function check({ container, expected, window, followed, followed_window }: Case, name: string): void {
  const data = new Uint8Array(Buffer.from(container, "base64"));
  expect(expectations(kernels, data), name).toEqual(expected);
  if (window) {
    const decoder = new Decoder(kernels);
    decoder.feed(data);
    const { region, level, layer, sha256 } = window;
    const shown = decoder.layers[layer]!.window(region, level);
    expect(digests(shown), `${name}, window ${region} of level ${level}`).toEqual(sha256);
    const { geotransform, axes, nodes } = shown.metadata;
    const placed = JSON.parse(JSON.stringify({ geotransform, axes, nodes }));
    expect(placed, `${name}, window ${region} of level ${level}`).toEqual(window.metadata);
  }
  checkViews(data, followed, new Decoder(kernels), `${name}, views of a plan`);
  if (followed_window === null) return;
  const { region, level } = followed_window;
  const what = `${name}, views of the window ${region} of level ${level}`;
  checkViews(data, followed_window, new Decoder(kernels, { region, level }), what);
}

function checkViews(data: Uint8Array, followed: Followed, decoder: Decoder, name: string): void {
  const views: View[] = [];
  for (const [offset, length] of followed.slices) {
    for (let at = offset; at < offset + length; at += followed.pieces) {
      views.push(...decoder.feedAt(at, data.subarray(at, Math.min(at + followed.pieces, offset + length))));
    }
  }
  expect(views.map(figures), name).toEqual(followed.views);
  expect(decoder.complete).toBe(followed.complete);
  const every = Math.max(1, Math.floor(views.length / 4));
  const shown = views.filter((_, i) => i % every === 0).map((view) => digests(view.surface()));
  expect(shown, name).toEqual(followed.sha256);
}
