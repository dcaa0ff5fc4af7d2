import { afterEach, describe, expect, it, vi } from "vitest";
import type { Header } from "../src/container/header";
import { readIndex } from "../src/container/reader";
import { describe as description, infoOf, NO_DESCRIPTION } from "../src/view/description";
import { containerOf, NAMES } from "./golden";

afterEach(() => vi.unstubAllGlobals());

const URL = "http://host/a.lode";
const data = containerOf(NAMES[0]!);

/** A host of this file; `body` makes the body of a part. */
function host(size: number, body: (first: number, past: number) => BodyInit): void {
  vi.stubGlobal("fetch", async (_: string, { headers }: { headers: Record<string, string> }) => {
    const [, first, last] = /bytes=(\d+)-(\d+)/.exec(headers.range!)!;
    const range = { "content-range": `bytes ${first}-${last}/${size}` };
    return new Response(body(Number(first), Number(last) + 1), { status: 206, headers: range });
  });
}

async function header(): Promise<Header> {
  return (await readIndex(async (offset, length) => data.subarray(offset, offset + length), data.length)).header;
}

describe("what is read of the end of a container", () => {
  it("is its size and its price list", async () => {
    host(data.length, (first, past) => data.slice(first, past) as BodyInit);
    const found = await description(URL, null, header());
    expect(found.size).toBe(data.length);
    expect(found.prices!.length).toBeGreaterThan(0);
  });

  it.each([
    [{ crs: 'GEOGCRS["WGS 84"]' }, "°"],
    [{ geotransform: [0, 90, 0, 0, 0, 1], unit: "METERS" }, "°"],
    [{ geotransform: [0, 1, 0, 0, 0, 1], unit: "METERS" }, ""],
    [{ geotransform: [0, 1, 0, 0, 0, 1], crs: 'PROJCS["x",GEOGCS["y",UNIT["degree",1]],UNIT["metre",1]]' }, "m"],
    [{ unit: "m" }, "cells"],
    [{ axes: 3 }, ""],
  ])("tells the unit of x and y, and whether maps can show it: %j", async (metadata, unit) => {
    const closed = [false, true] as const;
    const heights = { ...(await header()), pointChannels: 1, plane: null, shape: [3, 4], closed } as unknown as Header;
    const info = infoOf({ ...heights, blocks: [{ shape: [3, 4], closed }] } as unknown as Header, {
      ...NO_DESCRIPTION,
      metadata,
    });
    expect(info.planeUnit).toBe(unit);
    expect(info.mapped).toBe("crs" in metadata && "geotransform" in metadata);
  });

  it("never calls exact what a mesh was resampled into", async () => {
    const whole = { ...(await header()), exact: true } as Header;
    const exact = (metadata: Record<string, unknown>): boolean => infoOf(whole, { ...NO_DESCRIPTION, metadata }).exact;
    expect(exact({})).toBe(true);
    expect(exact({ remesh: { blocks: 98 } })).toBe(false);
  });

  it("is no more than was asked for", async () => {
    let pulls = 0;
    const endless = (): BodyInit =>
      new ReadableStream({
        pull(controller) {
          pulls += 1;
          if (pulls > 1000) controller.error(new Error("this was not to be read"));
          else controller.enqueue(new Uint8Array(4096));
        },
      });
    host(data.length, endless);
    await expect(description(URL, null, header())).rejects.toThrow("got more");
    expect(pulls).toBeLessThan(10);
  });

  it("is not made room for beyond what a surface may take", async () => {
    host(data.length, (first, past) => data.slice(first, past) as BodyInit);
    const announced = { ...(await header()), tables: 2 ** 40 } as unknown as Header;
    await expect(description(URL, null, Promise.resolve(announced))).rejects.toThrow("at most 3072 MiB");
  });
});
