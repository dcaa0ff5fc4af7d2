/** Conversion of server answers and failed connections to the errors of Lodestream. */

import {
  InputError,
  type LodestreamError,
  NotFoundError,
  OptionError,
  RemoteError,
  SilenceError,
  TooLargeError,
  TruncatedStreamError,
  UnreachableError,
} from "../errors";

const LONGEST = 1000;

// The server's words, over HTTP and in the stream alike; then statuses, for what other servers and proxies answer.
const BY_CODE: Readonly<Record<string, new (message: string) => LodestreamError>> = {
  "bad-input": InputError,
  "bad-option": OptionError,
  "bad-target": OptionError,
  "not-found": NotFoundError,
  "too-large": TooLargeError,
};
const BY_STATUS: Readonly<Record<number, new (message: string) => LodestreamError>> = {
  400: InputError,
  404: NotFoundError,
  413: TooLargeError,
  415: InputError,
  422: InputError,
};

// What a server says when it may be otherwise a little later.
const PASSING = new Set(["restarting", "idle", "busy", "too-many", "internal"]);
for (const status of [408, 425, 429, 500, 502, 503, 504]) PASSING.add(`http-${status}`);

/** A WebSocket that did not open, or does not speak the stream protocol: plain HTTP may get through. */
export class NoStreamError extends UnreachableError {}

/** A file that its host says is shorter than the container that it begins. */
export class CutShortError extends TruncatedStreamError {}

/** The error for an error code of the server. */
export function fromCode(code: string, message: string): LodestreamError {
  const kind = Object.hasOwn(BY_CODE, code) ? BY_CODE[code] : undefined;
  return kind === undefined ? new RemoteError(code, message) : new kind(message);
}

/**
 * The error for an HTTP answer.
 *
 * @param body A problem document (RFC 9457), whose `detail` becomes the message, or anything else.
 * @param url The URL of the request; named if the answer does not explain itself.
 */
export function fromResponse(status: number, reason: string, body: string, url: string): LodestreamError {
  const document = parsed(body);
  const detail = textOf(document.detail) ?? textOf(document.title);
  const message = detail?.slice(0, LONGEST) ?? `the server answered ${status} ${reason} for ${url}`;
  const { code } = document;
  if (typeof code === "string") return fromCode(code, message);
  const kind = BY_STATUS[status];
  return kind === undefined ? new RemoteError(`http-${status}`, message) : new kind(message);
}

/**
 * Whether the connection broke in the head of an answer without a body. Over plain HTTP, Chromium hands on what has come
 * of a head as if it were whole: a status of 20, a range without its last digits.
 */
export function isCutShort({ status, ok, headers }: Response): boolean {
  // A redirect is handed on only if it does not say where it leads.
  if (status < 200 || (status >= 300 && status < 400)) return true;
  return ok && headers.get("content-length") !== "0";
}

/** The error for an answer that was cut short. */
export function brokeOff(url: string): UnreachableError {
  return new UnreachableError(`no connection to ${url}, or it broke: the answer has no body`);
}

/** Whether the same request may succeed a little later. */
export function passes(error: LodestreamError): boolean {
  if (error instanceof RemoteError) return PASSING.has(error.code);
  if (error instanceof CutShortError) return false;
  return error instanceof UnreachableError || error instanceof SilenceError || error instanceof TruncatedStreamError;
}

function parsed(body: string): Record<string, unknown> {
  try {
    const document: unknown = JSON.parse(body);
    return typeof document === "object" && document !== null ? (document as Record<string, unknown>) : {};
  } catch {
    return {};
  }
}

function textOf(value: unknown): string | undefined {
  return typeof value === "string" && value !== "" ? value : undefined;
}
