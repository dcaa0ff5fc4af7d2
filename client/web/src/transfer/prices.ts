/** What each error costs: the price list of a surface, from its index or from what its server says of it. */

import type { Index } from "../container/model";
import { LodestreamError, RemoteProtocolError, SilenceError, UnreachableError } from "../errors";
import { sameOrigin } from "./addresses";
import { fromResponse } from "./problems";

/** A layer: what it costs from the beginning of the container on, and the errors that then hold. */
export interface Price {
  /** Bytes of the container from its beginning. */
  readonly bytes: number;
  /** The finest level with data. */
  readonly level: number;
  /** Measured errors at full resolution, in the surface's unit. */
  readonly rms: number;
  readonly maxError: number;
}

/** The prices in an index: of each layer, and of what makes the surface exact after them. */
export function pricesOf(index: Index): Price[] {
  const prices = index.layers.map(({ end, level, errors }) => ({
    bytes: end,
    level,
    rms: errors.rms,
    maxError: errors.maximum,
  }));
  if (index.residual !== null) {
    const { rms, maximum } = index.levels[index.levels.length - 1]!.errors;
    prices.push({ bytes: index.surfaceEnd, level: index.header.levels, rms, maxError: maximum });
  }
  return prices;
}

// A list of a few thousand layers takes some hundred kilobytes.
const LONGEST = 16 * 1024 * 1024;

/**
 * The prices of a surface on a server.
 *
 * @param url Of the surface.
 * @param patience Seconds that the answer may take.
 * @throws LodestreamError if there is no such surface, or the server does not say.
 */
export async function fetchPrices(
  url: string,
  token: string | undefined,
  patience: number,
  fetch: typeof globalThis.fetch,
): Promise<Price[]> {
  const headers = token === undefined ? {} : { Authorization: `Bearer ${token}` };
  const options: RequestInit = { headers, cache: "no-store", signal: AbortSignal.timeout(1000 * patience) };
  try {
    return await askedFor(url, () => fetch(url, options));
  } catch (error) {
    if (error instanceof LodestreamError) throw error;
    const { name, message } = error as Error;
    if (name === "TimeoutError")
      throw new SilenceError(`expected the layers of ${url} in ${patience} seconds, got none`);
    throw new UnreachableError(`no connection to ${url}, or it broke: ${message}`);
  }
}

async function askedFor(url: string, ask: () => Promise<Response>): Promise<Price[]> {
  const response = await ask();
  if (response.url !== "" && !sameOrigin(response.url, url)) {
    throw new RemoteProtocolError(`expected what ${url} says itself, got a redirect to another server`);
  }
  const body = await bounded(response);
  if (!response.ok) throw fromResponse(response.status, response.statusText, body, url);
  let document: { layers?: unknown };
  try {
    document = JSON.parse(body) as { layers?: unknown };
  } catch {
    document = {};
  }
  const { layers } = document;
  if (!Array.isArray(layers)) throw new RemoteProtocolError(`expected the layers of ${url}, got none`);
  return layers.map((layer: Record<string, unknown>) => {
    const [bytes, level, rms, maxError] = [layer?.bytes, layer?.level, layer?.rms, layer?.max];
    for (const figure of [bytes, level, rms, maxError]) {
      if (typeof figure !== "number" || !Number.isFinite(figure) || figure < 0) {
        throw new RemoteProtocolError(`expected layers with bytes, level, rms and max from ${url}, got others`);
      }
    }
    return { bytes, level, rms, maxError } as Price;
  });
}

async function bounded(response: Response): Promise<string> {
  const decoder = new TextDecoder();
  const reader = response.body?.getReader();
  let text = "";
  let left = LONGEST;
  for (;;) {
    const slice = (await reader?.read())?.value;
    if (slice === undefined) return text + decoder.decode();
    left -= slice.length;
    if (left < 0) {
      await reader?.cancel();
      throw new RemoteProtocolError(`expected an answer of at most ${LONGEST} bytes, got more`);
    }
    text += decoder.decode(slice, { stream: true });
  }
}
