/** The public API, in the program's own thread and with a worker of Node. */
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { Worker as NodeWorker } from "node:worker_threads";
import { build } from "vite";
import { afterAll, beforeAll, describe, expect, it } from "vitest";
import WebSocket from "ws";
import {
  type ConnectOptions,
  CorruptStreamError,
  connect,
  type Description,
  decode,
  InputError,
  loadKernels,
  NotFoundError,
  OptionError,
  type Progress,
  type SocketClass,
  type StreamState,
  type Surface,
  type SurfaceView,
  UnavailableError,
  type WorkerLike,
} from "../src";
import { Faulty, type Served, serve } from "./servers";

let served: Served;
let whole: Surface;
let folder: string;
const workers: NodeWorker[] = [];

beforeAll(async () => {
  folder = mkdtempSync(join(tmpdir(), "lodestream-worker-"));
  const entry = resolve(import.meta.dirname ?? ".", "node-worker.ts");
  const external = [/^node:/, "ws"];
  const [started] = await Promise.all([
    serve(),
    build({
      configFile: false,
      logLevel: "error",
      build: {
        ...{ outDir: folder, ssr: entry, minify: true, target: "es2022" },
        rolldownOptions: { external, output: { entryFileNames: "worker.mjs" } },
      },
      ssr: { noExternal: ["@msgpack/msgpack"] },
    }),
  ]);
  served = started;
  whole = await decode(await loadKernels(), served.data);
});

afterAll(async () => {
  await Promise.all(workers.map((worker) => worker.terminate()));
  rmSync(folder, { recursive: true, force: true });
  await served?.stop();
});

/** A worker of Node as a page's worker. */
function nodeWorker(): WorkerLike {
  // Where the bundle cannot find `ws` by itself, it is told where it is.
  const worker = new NodeWorker(join(folder, "worker.mjs"), { workerData: { ws: import.meta.resolve("ws") } });
  workers.push(worker);
  const like: WorkerLike = {
    postMessage: (message, transfer) => worker.postMessage(message, transfer as never),
    terminate: () => worker.terminate(),
    onmessage: null,
    onerror: null,
  };
  worker.on("message", (data) => like.onmessage?.({ data } as MessageEvent));
  worker.on("error", (error) => like.onerror?.({ message: error.message } as ErrorEvent));
  return like;
}

const WAYS: [string, () => ConnectOptions][] = [
  ["in the same thread", () => ({ WebSocket: WebSocket as unknown as SocketClass })],
  ["in a worker", () => ({ worker: nodeWorker })],
];

describe.each(WAYS)("%s", (_, way) => {
  const options = (more: ConnectOptions = {}): ConnectOptions => ({ ...way(), closeTimeout: 0.5, ...more });

  it("a surface of a server, a file of a web server and a Blob end with the original", async () => {
    const blob = new Blob([served.data as Uint8Array<ArrayBuffer>]);
    for (const source of [served.surface, new URL(served.static), blob]) {
      const states: StreamState[] = [];
      const progress: Progress[] = [];
      const descriptions: Description[] = [];
      const slices: [number, Uint8Array][] = [];
      const stream = connect(
        source,
        {},
        {
          ...options(),
          onState: (state) => void states.push(state),
          onProgress: (now) => void progress.push(now),
          onDescription: (now) => void descriptions.push(now),
          onBytes: (offset, data) => void slices.push([offset, data]),
        },
      );
      let last: SurfaceView | undefined;
      for await (const view of stream) {
        expect(view.bytes).toBeGreaterThan(last?.bytes ?? 0);
        last = view;
      }
      expect(stream.ended).toBe("complete");
      expect(states.map((state) => state.phase)).toEqual(["connecting", "streaming", "ended"]);
      const { blocks, metadata } = await last!.surface();
      expect(blocks[0]!.points).toEqual(whole.blocks[0]!.points);
      expect(metadata).toMatchObject({ name: "terrain" });
      const coarse = await last!.surface(2);
      expect(coarse.blocks[0]!.shape).not.toEqual(blocks[0]!.shape);
      const window = await last!.window(
        [
          [3, 5],
          [7, 9],
        ].map((span) => span) as never,
      );
      expect(window.blocks[0]!.points.values.length).toBe(4);
      expect(stream.description).toEqual(descriptions.at(-1));
      expect(stream.description).toMatchObject({
        ...{ blocks: [{ shape: [361, 281] }], dtype: "int16", exact: true, joined: false },
        ...{ size: served.data.length, metadata: { name: "terrain" } },
      });
      expect({ ...stream.progress, seconds: progress.at(-1)!.seconds }).toEqual(progress.at(-1));
      for (const [offset, data] of slices) {
        expect(Buffer.from(data).equals(Buffer.from(served.data.subarray(offset, offset + data.length)))).toBe(true);
      }
      expect(slices.reduce((sum, [, data]) => sum + data.length, 0)).toBe(stream.progress.dataBytes);
      const prices = await stream.prices();
      expect(prices.at(-1)).toMatchObject({ bytes: last!.bytes, rms: 0, maxError: 0 });
      expect(prices.map((price) => price.bytes)).toEqual(prices.map((p) => p.bytes).toSorted((a, b) => a - b));
      await stream.close();
      await expect(last!.surface()).rejects.toThrow(UnavailableError);
    }
  });

  it("looking elsewhere, another target, a stop, and going on", async () => {
    const stream = connect(served.surface, { untilRms: "1%" }, options({ window: 4000 }));
    for await (const view of stream)
      if (view.number === 1)
        await stream.focus([
          [0, 20],
          [0, 20],
        ]);
    expect(stream.ended).toBe("rms");
    await stream.aim({});
    expect(stream.ended).toBeUndefined();
    for await (const view of stream) if (view.bytes > 30_000) await stream.stop();
    expect(stream.ended).toBe("stopped");
    const before = stream.progress.dataBytes;
    await stream.aim({});
    let last: SurfaceView | undefined;
    for await (const view of stream) last = view;
    expect(stream.ended).toBe("complete");
    expect(stream.progress.dataBytes).toBeGreaterThan(before);
    expect(stream.progress.dataBytes).toBeLessThanOrEqual(served.data.length);
    expect((await last!.surface()).blocks[0]!.points).toEqual(whole.blocks[0]!.points);
    await expect(
      stream.focus([
        [0, 9999],
        [0, 1],
      ]),
    ).resolves.toBeUndefined(); // it has ended
    await expect(
      stream.aim({
        region: [
          [0, 1],
          [0, 1],
        ],
      }),
    ).rejects.toThrow(OptionError);
    await stream.close();
  });

  it("bytes that are kept are not asked for again", async () => {
    const first = connect(served.surface, { maxBytes: 9000 }, options({ keep: true }));
    for await (const _view of first);
    const kept = await first.kept();
    await first.close();
    expect(kept.size).toBe(served.data.length);
    const cached = kept.slices.reduce((sum, [, data]) => sum + data.length, 0);
    expect(cached).toBe(first.progress.dataBytes);
    // A file that is the same but for its name.
    const again = connect(served.static, {}, options({ kept: { ...kept, version: undefined } }));
    let last: SurfaceView | undefined;
    for await (const view of again) last = view;
    expect(again.ended).toBe("complete");
    expect(again.progress.dataBytes).toBeLessThanOrEqual(served.data.length - cached);
    expect((await last!.surface()).blocks[0]!.points).toEqual(whole.blocks[0]!.points);
    await again.close();
  });

  it("bytes of a file that has changed since are not mixed with others", async () => {
    const first = connect(served.static, { maxBytes: 9000 }, options({ keep: true }));
    for await (const _view of first);
    const kept = await first.kept();
    expect(kept.version).toMatch(/^"/);
    expect(kept.container).toBeUndefined();
    await first.close();
    const again = connect(served.static, {}, options({ kept }));
    for await (const _view of again);
    expect(again.ended).toBe("complete");
    await again.close();
    const other = connect(served.static, {}, options({ kept: { ...kept, version: '"another"' } }));
    const views: SurfaceView[] = [];
    const received = async () => {
      for await (const view of other) views.push(view);
    };
    await expect(received()).rejects.toMatchObject({ code: "other-container" });
    expect(views.length).toBeGreaterThan(0); // what is cached is shown at once
    expect(views.at(-1)!.bytes).toBeLessThanOrEqual(9000);
    await other.close();
  });

  it("a token, a rate that changes, and a link that breaks", async () => {
    const link = await Faulty.to(served.closed, (number) => (number < 3 ? { cutDown: 9000 } : {}));
    try {
      const states: StreamState[] = [];
      const more = {
        token: served.token,
        limitRate: 200_000,
        onState: (state: StreamState) => void states.push(state),
      };
      const stream = connect(link.url, {}, options({ ...more, window: 3000, pauses: { first: 0.01, longest: 0.1 } }));
      for await (const view of stream) if (view.number === 3) await stream.throttle(undefined);
      expect(stream.ended).toBe("complete");
      expect(states.map((state) => state.phase)).toContain("reconnecting");
      expect((await stream.prices()).length).toBeGreaterThan(5);
      await stream.close();
    } finally {
      await link.close();
    }
  });

  it("errors keep their classes, codes and offsets", async () => {
    const missing = connect(served.surface.replace(/[^/]+$/, "0123456789abcdef0123"), {}, options());
    await expect(missing.next()).rejects.toThrow(NotFoundError);
    expect(missing.ended).toBe("truncated");
    await missing.close();
    const closed = connect(served.closed, {}, options());
    await expect(closed.next()).rejects.toMatchObject({ name: "RemoteError", code: "no-token" });
    await closed.close();
    const data = served.data.slice();
    data[20_000]! ^= 4;
    const damaged = connect(new Blob([data as Uint8Array<ArrayBuffer>]), {}, options());
    const error = await (async () => {
      for await (const _view of damaged);
    })().catch((each: unknown) => each);
    expect(error).toBeInstanceOf(CorruptStreamError);
    expect((error as CorruptStreamError).offset).toBeGreaterThan(0);
    await damaged.close();
    const level = connect(served.static, {}, options());
    const { value } = await level.next();
    await expect(value!.surface(77)).rejects.toThrow(/expected a level of 0 to/);
    await level.return();
    expect(level.ended).toBe("stopped");
    await level.close();
    const small = connect(served.static, {}, options({ maxVertices: 100 }));
    await expect(small.next()).rejects.toMatchObject({ name: "TooLargeError" });
    await small.close();
  });
});

describe("what cannot be received", () => {
  it("is told before anything is asked for", async () => {
    expect(() => connect("http://127.0.0.1:9/a.lode", { level: 1, maxBytes: 2 })).toThrow(OptionError);
    expect(() => connect("http://127.0.0.1:9/a.lode", { untilRms: "much" })).toThrow(
      /"much" is not an error bound: write 0 or more/,
    );
    expect(() => connect("http://127.0.0.1:9/")).toThrow(OptionError);
    expect(() => connect("surfaces/alps")).toThrow(/expected an address such as/);
    await expect(connect("http://127.0.0.1:9/a.lode", {}, { silence: -1 }).next()).rejects.toThrow(OptionError);
    const both = connect("http://127.0.0.1:9/a.lode", {}, { worker: true, fetch: globalThis.fetch });
    await expect(both.next()).rejects.toThrow(/without a worker/);
  });

  it("a worker that cannot be started is told too", async () => {
    const worker = (): WorkerLike => {
      const like: WorkerLike = {
        postMessage: () => undefined,
        terminate: () => undefined,
        onmessage: null,
        onerror: null,
      };
      setTimeout(() => like.onerror?.({ message: "no such file" } as ErrorEvent), 10);
      return like;
    };
    const stream = connect("http://127.0.0.1:9/a.lode", {}, { worker });
    await expect(stream.next()).rejects.toThrow(/the worker failed: no such file/);
    await stream.close();
    expect(InputError.prototype.name).toBe("InputError");
  });
});
