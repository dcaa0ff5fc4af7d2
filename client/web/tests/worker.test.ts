import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { Worker } from "node:worker_threads";
import { build } from "vite";
import { afterAll, beforeAll, describe, expect, it } from "vitest";
import { readIndex } from "../src/container";
import { type Port, RemoteDecoder } from "../src/decoding";
import { CorruptStreamError, OptionError, TruncatedStreamError, UnavailableError } from "../src/errors";
import { containerOf, digests, EXPECTED, NAMES, ROOT } from "./golden";

const folder = mkdtempSync(join(tmpdir(), "lodestream-worker-"));
let worker: Worker;

/** A worker of Node as one of a browser. */
function portOf(thread: Worker): Port {
  const given = new Map<unknown, (data: unknown) => void>();
  return {
    postMessage: (message, transfer) => thread.postMessage(message, transfer as unknown as ArrayBuffer[]),
    addEventListener: (_, listener) => {
      given.set(listener, (data) => listener({ data }));
      thread.on("message", given.get(listener)!);
    },
    removeEventListener: (_, listener) => thread.off("message", given.get(listener)!),
  };
}

beforeAll(async () => {
  const entry = join(ROOT, "client/web/src/decoding/worker/entry.ts");
  await build({
    configFile: false,
    logLevel: "error",
    build: {
      outDir: folder,
      target: "es2022",
      lib: { entry, formats: ["es"], fileName: () => "worker.mjs" },
      rolldownOptions: { external: [/^node:/] },
    },
  });
  worker = new Worker(join(folder, "worker.mjs"));
});

afterAll(async () => {
  await worker.terminate();
  rmSync(folder, { recursive: true });
});

describe("a decoder in a worker", () => {
  it.each(NAMES)("%s is the same bit for bit at every layer and level", async (name) => {
    const expected = EXPECTED[name]!;
    const decoder = await RemoteDecoder.open(portOf(worker));
    await decoder.feed(containerOf(name));
    await decoder.finish();
    const layers: typeof expected.layers = [];
    for (const view of decoder.layers) {
      const { bytes, level, rms, maxError } = view;
      layers.push({ bytes, level, rms, max: maxError, sha256: digests(await view.surface()) });
    }
    expect(layers).toEqual(expected.layers);
    const last = decoder.layers.at(-1)!;
    // Where x and y are a rule, those of coarser levels are not specified.
    const data = containerOf(name);
    const index = await readIndex(async (offset, length) => data.subarray(offset, offset + length), data.length);
    const heights = index.header.plane !== null;
    for (const [level, wanted] of expected.levels.entries()) {
      const surface = await last.surface(level);
      expect(digests(surface, heights && level < expected.levels.length - 1)).toEqual(wanted);
    }
    decoder.close();
    await expect(last.surface()).rejects.toBeInstanceOf(UnavailableError);
  });

  it("tells errors of their classes, and the views before them", async () => {
    const name = "heights-int16";
    const data = containerOf(name);
    const { layers } = EXPECTED[name]!;
    data[layers[2]!.bytes + 20]! ^= 1;
    const decoder = await RemoteDecoder.open(portOf(worker));
    const error = await decoder.feed(data).catch((caught: unknown) => caught);
    expect(error).toBeInstanceOf(CorruptStreamError);
    expect((error as CorruptStreamError).offset).toBe(layers[2]!.bytes);
    expect((error as CorruptStreamError).message).toMatch(/^expected .* \(at byte \d+\)$/);
    expect(decoder.layers.map((view) => view.bytes)).toEqual(layers.slice(0, 3).map((layer) => layer.bytes));
    await expect(decoder.finish()).rejects.toBeInstanceOf(TruncatedStreamError);
    await expect(decoder.layers[0]!.surface(99)).rejects.toBeInstanceOf(OptionError);
    expect(digests(await decoder.layers[2]!.surface())).toEqual(layers[2]!.sha256);
    decoder.close();
  });

  it("does calls in the order in which they were made, and shows windows", async () => {
    const data = containerOf("several-tiles");
    const decoder = await RemoteDecoder.open(portOf(worker));
    const chunks = Array.from({ length: 20 }, (_, i) =>
      data.slice((i * data.length) / 20, ((i + 1) * data.length) / 20),
    );
    await Promise.all(chunks.map((chunk) => decoder.feed(chunk)));
    expect(decoder.complete).toBe(true);
    const whole = await decoder.layers.at(-1)!.surface();
    const window = await decoder.layers.at(-1)!.window([
      [10, 20],
      [3, 40],
    ]);
    const block = whole.blocks[0]!;
    const width = block.shape[1] * block.points.components;
    const rows = Array.from({ length: 10 }, (_, i) => {
      const start = (10 + i) * width;
      return [...block.points.values.slice(start + 3 * block.points.components, start + 40 * block.points.components)];
    });
    expect([...window.blocks[0]!.points.values]).toEqual(rows.flat());
    decoder.close();
  });
});
