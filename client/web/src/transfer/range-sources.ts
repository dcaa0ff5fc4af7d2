/** Parts of a file: over HTTP with `fetch`, or of a `File` or `Blob`. */

import { UnreachableError } from "../errors";
import { containerUrl } from "./addresses";
import type { Place } from "./locating";
import { Patience } from "./patience";
import { brokeOff, fromResponse, isCutShort } from "./problems";
import type { AnswerHeaders, RangeRequest } from "./range-download";

/** The answer to a request for a range. */
export interface RangeAnswer {
  readonly status: number;
  readonly headers: AnswerHeaders;
  /** The next bytes of the body, undefined at its end. */
  read(): Promise<Uint8Array | undefined>;
}

/** What gives parts of a file. Aborting the signal ends a request at any time. */
export interface RangeSource {
  /**
   * Ask for a range.
   *
   * @param patience Gives the seconds without data after which an answer counts as lost.
   * @throws LodestreamError if it is refused or there is no answer.
   */
  ask(request: RangeRequest, patience: () => number, signal: AbortSignal): Promise<RangeAnswer>;
}

/** Statuses of answers that say something of the file asked for; with others, the body says what is wrong. */
const ABOUT_FILE = new Set([200, 206, 416]);

const LONGEST_PROBLEM = 64 * 1024;

/** A container on a server of Lodestream or on any web server that knows Range. */
export class HttpRanges implements RangeSource {
  private address: string | undefined;

  /** @param place Of the container. A redirect is followed, and its target is asked from then on. */
  constructor(
    private readonly place: Place,
    private readonly fetch: typeof globalThis.fetch,
  ) {}

  async ask(request: RangeRequest, patience: () => number, signal: AbortSignal): Promise<RangeAnswer> {
    const { place } = this;
    this.address ??= containerUrl(await place.find(patience, signal));
    const timer = new Patience(patience, signal);
    const headers = { ...request.headers, ...place.authorization(this.address) };
    const asked = this.address;
    // No cache comes between: browsers lock an address in theirs while one part of it is under way.
    const options: RequestInit = { headers, cache: "no-store", credentials: "same-origin", signal: timer.signal };
    const response = await timer.wait(asked, () => this.fetch(asked, options));
    const reader = response.body?.getReader();
    const slice = async (): Promise<Uint8Array | undefined> => {
      const { value } = (await timer.wait(asked, async () => reader?.read())) ?? {};
      if (value === undefined) timer.end();
      return value;
    };
    let first = await slice();
    if (first === undefined && isCutShort(response)) throw brokeOff(asked);
    const read = async (): Promise<Uint8Array | undefined> => {
      const next = first ?? (await slice());
      first = undefined;
      return next;
    };
    if (!ABOUT_FILE.has(response.status)) {
      const body = await textOf(read);
      timer.end();
      throw fromResponse(response.status, response.statusText, body, asked);
    }
    if (response.url !== "") this.address = response.url;
    return { status: response.status, headers: response.headers, read };
  }
}

async function textOf(read: () => Promise<Uint8Array | undefined>): Promise<string> {
  const decoder = new TextDecoder();
  let text = "";
  for (let left = LONGEST_PROBLEM; left > 0; ) {
    const slice = await read();
    if (slice === undefined) break;
    text += decoder.decode(slice.subarray(0, left), { stream: true });
    left -= slice.length;
  }
  return text;
}

// Bytes that are decoded before more are read.
const SLICE = 64 * 1024;

/** A `File` or `Blob`, which answers like a server. */
export class BlobRanges implements RangeSource {
  constructor(private readonly blob: Blob) {}

  async ask(request: RangeRequest, _patience: () => number, signal: AbortSignal): Promise<RangeAnswer> {
    const { size } = this.blob;
    const last = Math.min(request.end, size) - 1;
    const headers = new Map([["content-range", `bytes ${request.offset}-${last}/${size}`]]);
    let position = request.offset;
    const read = async (): Promise<Uint8Array | undefined> => {
      if (position > last || signal.aborted) return undefined;
      const slice = this.blob.slice(position, Math.min(position + SLICE, last + 1));
      let data: ArrayBuffer;
      try {
        data = await slice.arrayBuffer();
      } catch (error) {
        // A file that was changed or removed since it was chosen.
        throw new UnreachableError(`the file cannot be read: ${(error as Error).message}`);
      }
      position += data.byteLength;
      return new Uint8Array(data);
    };
    return {
      status: last < request.offset ? 416 : 206,
      headers: { get: (name) => headers.get(name.toLowerCase()) ?? null },
      read,
    };
  }
}
