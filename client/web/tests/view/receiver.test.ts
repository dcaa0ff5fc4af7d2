import { afterEach, expect, it, vi } from "vitest";
import { Decoder } from "../../src/decoding/decoder";
import type { View } from "../../src/decoding/view";
import { loadKernels } from "../../src/kernels/instance";
import { Receiver } from "../../src/view/receiver";
import type { Moment, Progress, SurfaceInfo } from "../../src/view/source";
import { containerOf } from "../golden";

afterEach(() => {
  vi.unstubAllGlobals();
  vi.restoreAllMocks();
});

/** A host of one file, which may become another. */
function host(data: Uint8Array): { data: Uint8Array } {
  const file = { data };
  vi.stubGlobal("fetch", async (_: string, { headers }: { headers: Record<string, string> }) => {
    const [, first, last] = /bytes=(\d+)-(\d+)/.exec(new Headers(headers).get("range")!)!.map(Number);
    const size = file.data.length;
    const end = Math.min(last!, size - 1);
    const told = { "content-range": `bytes ${first}-${end}/${size}`, etag: `"${size}"` };
    const body = file.data.slice(first, end + 1) as BodyInit;
    return end < first! ? new Response(null, { status: 416 }) : new Response(body, { status: 206, headers: told });
  });
  return file;
}

interface Heard {
  readonly receiver: Receiver;
  readonly infos: SurfaceInfo[];
  readonly moments: Moment[];
  readonly progress: Progress[];
}

function receive(): Heard {
  const infos: SurfaceInfo[] = [];
  const moments: Moment[] = [];
  const progress: Progress[] = [];
  const receiver = new Receiver({
    info: (info) => infos.push(info),
    moment: (moment) => moments.push(moment),
    progress: (now) => progress.push(now),
    refined: () => {},
  });
  return { receiver, infos, moments, progress };
}

it.each(["heights-int16", "blocks-integers"])("%s: what is complete is hashed by the platform, once", async (name) => {
  const data = containerOf(name);
  host(data);
  const { receiver, moments } = receive();
  await receiver.open("http://host/a.lode", null);
  await expect.poll(() => moments.at(-1)?.complete).toBe(true);
  const decoder = new Decoder(await loadKernels());
  decoder.feed(data);
  const { levels } = decoder.header!;
  const exact = decoder.surface().blocks;
  const digest = vi.spyOn(globalThis.crypto.subtle, "digest");
  const coarse = await receiver.grids(0, levels - 1, null);
  expect(coarse.moment).toBe(0);
  expect(digest).not.toHaveBeenCalled();
  const { moment, grids } = await receiver.grids(null, levels, null);
  expect(moment).toBe(moments.length - 1);
  expect(digest).toHaveBeenCalledOnce();
  expect(grids.length).toBe(exact.length);
  for (const [number, { points }] of grids.entries()) {
    const { components, values } = exact[number]!.points;
    const last = Math.min(components, 3) - 1;
    const heights = Array.from(values, Number).filter((_, k) => k % components === last);
    expect([...points.filter((_, k) => k % 3 === 2)]).toEqual(heights);
  }
  const { point } = await receiver.valuesAt(moments.length - 1, 0, 1, 2);
  expect(point.at(-1)).toBe(grids[0]!.points[3 * (exact[0]!.shape[1] + 2) + 2]);
});

it("a file that was cut short is of no use to another attempt, also when it is whole", async () => {
  const data = containerOf("heights-int16");
  const file = host(data.slice(0, -300));
  const { receiver, progress } = receive();
  await receiver.open("http://host/a.lode", null);
  await expect.poll(() => progress.at(-1)?.state).toBe("failed");
  expect(progress.at(-1)).toMatchObject({ detail: expect.stringContaining("the file was cut short"), useless: true });
  file.data = data;
  progress.length = 0;
  receiver.resume();
  await expect.poll(() => progress.at(-1)?.state).toBe("failed");
  expect(progress.at(-1)).toMatchObject({ state: "failed", useless: true });
  const again = receive();
  await again.receiver.open("http://host/a.lode", null);
  await expect.poll(() => again.progress.at(-1)?.state).toBe("complete");
});

it("a description that comes after what it describes is told all the same, and nothing else again", async () => {
  host(containerOf("heights-int16"));
  const served = fetch;
  let release = (): void => {};
  const held = new Promise<void>((resolve) => {
    release = resolve;
  });
  vi.stubGlobal("fetch", async (url: string, options: RequestInit) => {
    if (new Headers(options.headers).get("range") === "bytes=0-0") await held; // how large it is, for its end
    return served(url, options);
  });
  const { receiver, infos, moments, progress } = receive();
  await receiver.open("http://host/a.lode", null);
  await expect.poll(() => moments.at(-1)?.complete).toBe(true);
  expect(progress.at(-1)?.state).toBe("complete");
  expect(infos).toMatchObject([{ prices: null }]);
  const came = moments.length;
  release();
  await expect.poll(() => infos.length).toBe(2);
  expect(infos[1]!.prices?.length).toBeGreaterThan(1);
  expect(moments.length).toBe(came);
});

it("a stop before there is a stream holds, until it is to go on", async () => {
  host(containerOf("heights-int16"));
  const { receiver, moments, progress } = receive();
  const opened = receiver.open("http://host/a.lode", null);
  receiver.stop();
  await opened;
  expect(progress.at(-1)?.state).toBe("stopped");
  expect(moments).toEqual([]);
  receiver.resume();
  await expect.poll(() => moments.at(-1)?.complete).toBe(true);
  const again = receive();
  const begun = again.receiver.open("http://host/a.lode", null);
  again.receiver.stop();
  again.receiver.resume();
  await begun;
  await expect.poll(() => again.moments.at(-1)?.complete).toBe(true);
});

it("a target may be the error of an attribute", async () => {
  const sample = containerOf("large-attributes");
  const decoder = new Decoder(await loadKernels());
  const views = decoder.feed(sample);
  const { attributes, pointChannels } = decoder.header!;
  const own = Math.max(attributes[0]!.components, 1);
  const errorOf = ({ channels }: View) =>
    Math.hypot(...channels.slice(pointChannels, pointChannels + own).map(([rms]) => rms));
  const limit = 1.000001 * errorOf(views[Math.floor(views.length / 2)]!);
  host(sample);
  const { receiver, moments, progress } = receive();
  receiver.setTarget({ rms: limit, attribute: attributes[0]!.name });
  await receiver.open("http://host/a.lode", null);
  await expect.poll(() => progress.at(-1)?.state).toBe("target");
  const met = views.findIndex((view) => errorOf(view) <= limit);
  await expect.poll(() => moments.map(({ bytes }) => bytes)).toEqual(views.slice(0, met + 1).map(({ bytes }) => bytes));
});
