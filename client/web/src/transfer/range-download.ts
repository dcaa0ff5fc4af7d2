/**
 * Receiving a surface over HTTP Range or from a file, without I/O.
 *
 * The client makes the plan that a server would follow over WebSocket. The first bytes of the file tell what it is and
 * how long, the last bytes contain its index. What the target needs of the rest is requested in few requests. Layers
 * within the first bytes are shown before the plan exists, if it is certain to contain them.
 */

import { RemoteError, RemoteProtocolError, TruncatedStreamError } from "../errors";
import { type Place, RangeSet } from "../planning/byte-ranges";
import { BASE_CREDIT, MIN_WINDOW } from "../protocol/messages";
import type { ViewInfo } from "../types";
import { CutShortError } from "./problems";
import type { ReceiverState } from "./receiver-state";
import { inFileOrder } from "./safe-prefix";

// The first bytes hold the header; of a target in the file's order they are asked for in such numbers that the first
// reconstructions come with them, and more where it is known that more is wanted. The last ones, some and a share of
// the file, hold index and metadata of most. Where they do not, one more request brings the rest: a round trip, which
// costs more than some bytes too many. For the same reason all the rest is asked for at once where it is short.
const HEAD = 4096;
const FIRST = MIN_WINDOW;
const FIRST_MOST = BASE_CREDIT;
const TAIL_SHARE = 100;
const TAIL_LEAST = 4096;
const TAIL_MOST = 64 * 1024;
const REST = 64 * 1024;

/** How parts of a file are asked for. */
export interface RangeLimits {
  /** Requests under way at once, at most; 2: while one answer arrives, the next one is on its way. */
  readonly requests: number;
  /** Bytes between two slices that are taken along, at most, even where a request for each would take longer. */
  readonly gap: number;
}

const LIMITS: RangeLimits = { requests: 2, gap: BASE_CREDIT };

const CONTENT_RANGE = /^\s*bytes\s+(\d{1,15})-(\d{1,15})\/(\d{1,15})\s*$/;
const CONTAINER_TAG = /^"([0-9a-f]{64})"$/;

/** Headers of an answer, by names in any case; `Headers` of the platform is one. */
export interface AnswerHeaders {
  get(name: string): string | null;
}

/** One request for a range of the file, and its answer: `answer`, then `receive` for its bytes, then `finish`. */
export class RangeRequest {
  /** The range; the file may end before. */
  readonly offset: number;
  readonly length: number;
  /** Headers of the request. */
  readonly headers: Readonly<Record<string, string>>;
  /** Where the next bytes of the body stand in the file. */
  position: number;
  answeredAt: number | undefined;

  constructor(
    place: Place,
    etag: string | undefined,
    readonly askedAt: number | undefined,
  ) {
    [this.offset, this.length] = place;
    this.position = this.offset;
    const range = { Range: `bytes=${this.offset}-${this.end - 1}` };
    this.headers = etag === undefined ? range : { ...range, "If-Range": etag };
  }

  /** The offset after the last byte that was asked for. */
  get end(): number {
    return this.offset + this.length;
  }

  /** Bytes that are still to come. */
  get left(): number {
    return this.end - this.position;
  }
}

/** What `request` gives: a request to make, if there is one now, and views that follow from what has arrived. */
export interface Asked<View> {
  readonly request: RangeRequest | undefined;
  readonly views: View[];
}

/**
 * Receiving a surface over HTTP Range: requests out, parts of the file in.
 *
 * The caller makes the request that `request` gives, passes status and headers of its answer to `answer` and its body,
 * cut anywhere, to `receive`, then calls `finish`. It may ask for another request while as many as `RangeLimits`
 * allow are under way. With no request under way and none given, the stream has ended. If a connection breaks, the caller
 * calls `leave`, and continues with the next `request`.
 */
export class RangeDownload<View extends ViewInfo> {
  /** Number of requests so far. */
  requests = 0;
  private validator: string | undefined;
  private etag: string | undefined;
  private needed: Place | undefined;
  private gap: number;
  private readonly underWay = new Set<RangeRequest>();

  /** @param version See `version`, of a file of which something is cached. */
  constructor(
    readonly reception: ReceiverState<View>,
    version?: string,
    private readonly limits: RangeLimits = LIMITS,
  ) {
    this.gap = Math.min(MIN_WINDOW, limits.gap);
    this.validator = version;
    this.etag = version?.startsWith('"') ? version : undefined;
    reception.keep();
  }

  /** Identifies this version of the file: its entity tag, or else its date; undefined if it has neither. */
  get version(): string | undefined {
    return this.validator;
  }

  /**
   * The next request, if one can be made now; with none under way and none made, the stream has ended.
   *
   * @param now Seconds of any clock that does not go back. The measured round-trip time and rate decide which slices
   * are requested together.
   * @throws CorruptStreamError, TruncatedStreamError, UnsupportedVersionError if the file is not a container that can be
   * read.
   * @throws OptionError if the container cannot meet the target.
   */
  request(now?: number): Asked<View> {
    const views: View[] = [];
    if (this.reception.ended !== undefined || this.underWay.size >= this.limits.requests)
      return { request: undefined, views };
    let place: Place | undefined;
    if (this.reception.plan === undefined) {
      place = this.first();
      if (place === undefined && this.endsCached()) {
        views.push(...this.readIndex());
        place = this.first();
      }
    }
    if (this.reception.plan !== undefined) {
      place = this.nextSlices();
      if (place === undefined && this.underWay.size === 0) this.reception.end(this.reception.plan.ended);
    }
    if (place === undefined) return { request: undefined, views };
    const request = new RangeRequest(place, this.etag, now);
    this.underWay.add(request);
    this.requests += 1;
    return { request, views };
  }

  /**
   * Take the status and headers of an answer: 200, 206 or 416; other answers say nothing about the file.
   *
   * @throws RemoteProtocolError if the server does not support Range, or the answer does not match the request.
   * @throws RemoteError with the code `other-container` if the file has changed.
   */
  answer(request: RangeRequest, status: number, headers: AnswerHeaders, now?: number): void {
    request.answeredAt = now;
    this.checkSame(headers, status);
    if (status === 416) {
      throw new CutShortError(`expected a container of at least ${request.offset + 1} bytes, got a shorter file`);
    }
    if (status !== 206) {
      throw new RemoteProtocolError(
        `expected part of the file (status 206), got all of it (status ${status}): ` +
          "the server does not support Range, without which no surface can be received in steps",
      );
    }
    const encoding = headers.get("content-encoding") ?? "identity";
    if (encoding !== "identity") {
      throw new RemoteProtocolError(`expected bytes of the file itself, got them encoded with ${printable(encoding)}`);
    }
    const told = headers.get("content-range");
    const found = CONTENT_RANGE.exec(told ?? "");
    if (found === null || Number(found[1]) !== request.offset) {
      const hidden = told === null ? " (a server of another site has to expose this header to pages)" : "";
      throw new RemoteProtocolError(
        `expected Content-Range to be bytes ${request.offset}-..., got ${told === null ? "none" : printable(told)}${hidden}`,
      );
    }
    const size = Number(found[3]);
    if (Number(found[2]) !== Math.min(request.end, size) - 1) {
      throw new RemoteProtocolError(
        `expected ${request.length} bytes from ${request.offset} on, got bytes ${printable(found[0])}`,
      );
    }
    this.reception.identify(CONTAINER_TAG.exec(this.etag ?? "")?.[1], size);
  }

  /**
   * Take more of the body of an answer; returns the views that it completes.
   *
   * @throws CorruptStreamError if the bytes of the container are damaged.
   * @throws RemoteProtocolError if there are more bytes than requested.
   */
  receive(request: RangeRequest, data: Uint8Array): View[] {
    this.reception.wireBytes += data.length;
    const start = request.position;
    request.position += data.length;
    if (request.position > request.end) {
      throw new RemoteProtocolError(`expected ${request.length} bytes of the file, got more`);
    }
    const views: View[] = [];
    // Until the index is known everything may be of use; then what lies between two slices is not kept.
    const places: Iterable<Place> =
      this.reception.plan === undefined ? [[start, data.length]] : this.reception.wanted(start, data.length);
    for (const [offset, length] of [...places]) {
      views.push(...this.reception.take(offset, data.subarray(offset - start, offset - start + length)));
    }
    return views;
  }

  /**
   * Declare the end of an answer's body.
   *
   * @throws TruncatedStreamError if the body was shorter than announced; the next `request` asks for the rest.
   */
  finish(request: RangeRequest, now?: number): void {
    this.underWay.delete(request);
    const expected = Math.min(request.length, (this.reception.size ?? 0) - request.offset);
    const got = request.position - request.offset;
    if (got < expected) {
      throw new TruncatedStreamError(`expected ${expected} bytes of the file from ${request.offset} on, got ${got}`);
    }
    this.measure(request, got, now);
  }

  /** Declare that the rest of an answer is not read. */
  leave(request: RangeRequest): void {
    this.underWay.delete(request);
  }

  /** Stop; the caller closes the connections. `why`: stopped or seconds. */
  stop(why: "stopped" | "seconds" = "stopped"): void {
    if (this.reception.ended !== undefined) return;
    this.reception.stoppedFor = why;
    this.reception.end("stopped");
  }

  /** Bytes that come in one round trip: skipping fewer would cost more than taking them. */
  private measure(request: RangeRequest, got: number, now: number | undefined): void {
    if (now === undefined || request.askedAt === undefined || request.answeredAt === undefined) return;
    const roundTrip = request.answeredAt - request.askedAt;
    if (got < MIN_WINDOW || roundTrip <= 0) return;
    const rate = got / Math.max(now - request.answeredAt, roundTrip);
    this.gap = Math.round(Math.min(Math.max(rate * roundTrip, MIN_WINDOW), this.limits.gap));
  }

  private checkSame(headers: AnswerHeaders, status: number): void {
    const etag = headers.get("etag") ?? "";
    const strong = etag.startsWith('"') ? etag : undefined;
    const validator = etag || (headers.get("last-modified") ?? undefined);
    const retagged = strong !== undefined && this.etag !== undefined && strong !== this.etag;
    // Where there is no strong tag, the date or a weak one is compared, as far as that goes.
    const changed = this.validator !== undefined && status !== 416 && validator !== this.validator;
    if (retagged || changed) {
      throw new RemoteError("other-container", "expected the file as it was before, got another: it has changed");
    }
    this.etag = strong ?? this.etag;
    this.validator = validator ?? this.validator;
  }

  /** What is neither cached nor under way of a range, in order. */
  private *open(offset: number, length: number): Generator<Place> {
    const coming = new RangeSet([...this.underWay].map((request) => [request.position, request.left] as const));
    for (const gap of this.reception.cached.missing(offset, length)) yield* coming.missing(...gap);
  }

  /** What to ask for before the index can be looked for. */
  private first(): Place | undefined {
    // How long the file is, the first answer tells.
    if (this.reception.size === undefined) return this.underWay.size === 0 ? [0, this.firstBytes()] : undefined;
    for (const place of this.ends(this.reception.size)) for (const gap of this.open(...place)) return gap;
    return undefined;
  }

  /** Where header and index of most containers are, and what was found to be missing beside them. */
  private ends(size: number): Place[] {
    const least = Math.min(TAIL_LEAST + Math.floor(size / TAIL_SHARE), TAIL_MOST, size);
    const [open] = this.open(0, size);
    const rest = open === undefined ? 0 : size - open[0];
    const tail = rest <= (this.wantsAll() ? REST : least + REST / 4) ? Math.max(least, rest) : least;
    const places: Place[] = [
      [0, Math.min(HEAD, size)],
      [size - tail, tail],
    ];
    return this.needed === undefined ? places : [...places, this.needed];
  }

  /** Whether the target is the whole file, as far as its order and its limits tell. */
  private wantsAll(): boolean {
    const { order: _, ...limits } = this.reception.target;
    return Object.values(limits).every((limit) => limit === undefined);
  }

  private endsCached(): boolean {
    const { size, cached } = this.reception;
    return size !== undefined && this.ends(size).every((place) => cached.covers(...place));
  }

  /** How many bytes to ask for first, of a file of which nothing is known. */
  private firstBytes(): number {
    const { target, cached } = this.reception;
    if (!inFileOrder(target) || cached.total > 0) return HEAD;
    if (target.maxBytes !== undefined) return Math.min(Math.max(target.maxBytes, HEAD), FIRST_MOST);
    const limited = target.untilRms ?? target.untilMax ?? target.channels ?? target.seconds;
    return limited === undefined ? FIRST_MOST : FIRST;
  }

  private readIndex(): View[] {
    try {
      const found = this.reception.find(this.reception.size ?? 0);
      if ("missing" in found) this.needed = found.missing;
      return "views" in found ? found.views : [];
    } catch (error) {
      // All bytes that the host has were looked at: others would not follow.
      if (error instanceof TruncatedStreamError) throw new CutShortError(`the file was cut short: ${error.message}`);
      throw error;
    }
  }

  /** The next slice that is missing, with those after it that are near and nothing between that is cached. */
  private nextSlices(): Place | undefined {
    let start = -1;
    let end = -1;
    for (const slice of this.reception.missing()) {
      for (const [offset, length] of this.open(...slice)) {
        if (start >= 0) {
          const gap = offset - end;
          if (gap < 0 || gap > this.gap) return [start, end - start];
          let open = 0;
          for (const [, size] of this.open(end, gap)) open += size;
          if (open < gap) return [start, end - start];
        } else start = offset;
        end = offset + length;
      }
    }
    return start < 0 ? undefined : [start, end - start];
  }
}

/** What a stranger sent, fit to print. */
function printable(text: string): string {
  return text.slice(0, 80).replace(/[^ -~]/g, "?");
}
