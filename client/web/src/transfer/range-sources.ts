/** Parts of a file: over HTTP with `fetch`, or of a `File` or `Blob`. */

import { LodestreamError, SilenceError, TruncatedStreamError, UnreachableError } from "../errors";
import { sameOrigin } from "./addresses";
import { fromResponse } from "./problems";
import { locate, publishedName } from "./published";
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
  /** Where the container is; until it is known, the name on a published page that leads to it. */
  located: string;
  private address: string;

  /**
   * @param url Where the container is, or a name on a published page that leads to it; a redirect is followed, and its target is asked from then on.
   * @param home The address that the token is for: it goes to no other origin.
   */
  constructor(
    url: string,
    private readonly home: string,
    private readonly token: string | undefined,
    private readonly fetch: typeof globalThis.fetch,
  ) {
    this.located = this.address = url;
  }

  async ask(request: RangeRequest, patience: () => number, signal: AbortSignal): Promise<RangeAnswer> {
    const timer = new Patience(patience, signal);
    const own: Record<string, string> = {};
    if (this.token !== undefined && sameOrigin(this.address, this.home)) own.Authorization = `Bearer ${this.token}`;
    if (publishedName(this.located) !== undefined) {
      // Once: the stream ends on the container that it begins, whatever the name leads to by then.
      const found = await timer.wait(this.located, () => locate(this.located, own, this.fetch, timer.signal));
      this.located = this.address = found;
    }
    const headers = { ...request.headers, ...own };
    const asked = this.address;
    // No cache comes between: browsers lock an address in theirs while one part of it is under way.
    const options: RequestInit = { headers, cache: "no-store", credentials: "same-origin", signal: timer.signal };
    const response = await timer.wait(asked, () => this.fetch(asked, options));
    const reader = response.body?.getReader();
    const read = async (): Promise<Uint8Array | undefined> => {
      const { value } = (await timer.wait(asked, async () => reader?.read())) ?? {};
      if (value === undefined) timer.end();
      return value;
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

/** Ends a request after a silence. */
class Patience {
  private readonly controller = new AbortController();
  private readonly abort = (): void => this.controller.abort();
  private silent = false;

  constructor(
    private readonly seconds: () => number,
    private readonly outer: AbortSignal,
  ) {
    if (outer.aborted) this.abort();
    outer.addEventListener("abort", this.abort);
  }

  get signal(): AbortSignal {
    return this.controller.signal;
  }

  /** The request has ended. */
  end(): void {
    this.outer.removeEventListener("abort", this.abort);
  }

  async wait<T>(url: string, step: () => Promise<T>): Promise<T> {
    const seconds = this.seconds();
    const timer = setTimeout(() => {
      this.silent = true;
      this.abort();
    }, 1000 * seconds);
    try {
      return await step();
    } catch (error) {
      this.end();
      if (error instanceof LodestreamError) throw error;
      if (this.silent) {
        throw new SilenceError(`expected more of the stream, but ${url} has sent nothing for ${seconds} seconds`);
      }
      if (this.outer.aborted) throw new TruncatedStreamError(`an answer of ${url} was left`);
      throw new UnreachableError(`no connection to ${url}, or it broke: ${(error as Error).message}`);
    } finally {
      clearTimeout(timer);
    }
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
