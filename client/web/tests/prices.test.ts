import { expect, it } from "vitest";
import { NotFoundError, RemoteProtocolError, SilenceError, UnreachableError } from "../src/errors";
import { fetchPrices } from "../src/transfer/prices";

const URL = "http://maps.example.org/v1/surfaces/alps";

/** What a server answers, and what it was asked with. */
function answering(body: unknown, status = 200): { fetch: typeof globalThis.fetch; asked: Headers[] } {
  const asked: Headers[] = [];
  const fetch = async (_: unknown, options?: RequestInit): Promise<Response> => {
    asked.push(new Headers(options?.headers));
    return new Response(typeof body === "string" ? body : JSON.stringify(body), { status });
  };
  return { fetch: fetch as typeof globalThis.fetch, asked };
}

it("prices are what a server says of the layers, asked for with the token", async () => {
  const layers = [
    { bytes: 70, level: 2, rms: 5.5, max: 9 },
    { bytes: 900, level: 4, rms: 0, max: 0 },
  ];
  const { fetch, asked } = answering({ layers, other: 1 });
  expect(await fetchPrices(URL, "secret", 5, fetch)).toEqual([
    { bytes: 70, level: 2, rms: 5.5, maxError: 9 },
    { bytes: 900, level: 4, rms: 0, maxError: 0 },
  ]);
  expect(asked[0]!.get("authorization")).toBe("Bearer secret");
  await fetchPrices(URL, undefined, 5, fetch);
  expect(asked[1]!.get("authorization")).toBeNull();
});

it.each([
  ["not JSON", 200, RemoteProtocolError],
  [{}, 200, RemoteProtocolError],
  [{ layers: [{ bytes: 1, level: 0, rms: "0", max: 1 }] }, 200, RemoteProtocolError],
  [{ layers: [null] }, 200, RemoteProtocolError],
  [{ layers: [{ bytes: -1, level: 0, rms: 0, max: 1 }] }, 200, RemoteProtocolError],
  [{ code: "not-found", detail: "No such surface" }, 404, NotFoundError],
])("%j with status %i is refused", async (body, status, kind) => {
  await expect(fetchPrices(URL, undefined, 5, answering(body, status).fetch)).rejects.toThrow(kind);
});

it("no answer, and no connection, are told apart", async () => {
  const silent = ((_: unknown, options?: RequestInit) =>
    new Promise((_resolve, reject) => {
      options?.signal?.addEventListener("abort", () => reject(options.signal!.reason));
    })) as typeof globalThis.fetch;
  await expect(fetchPrices(URL, undefined, 0.05, silent)).rejects.toThrow(SilenceError);
  const broken = (() => Promise.reject(new TypeError("fetch failed"))) as typeof globalThis.fetch;
  await expect(fetchPrices(URL, undefined, 1, broken)).rejects.toThrow(UnreachableError);
});
