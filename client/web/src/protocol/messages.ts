/**
 * The messages of a stream, and the error codes.
 *
 * An event that one side sends is received as the same event by the other side. `wire` has the bytes of messages,
 * `connection` their order; `docs/protocol.md` is the specification.
 */

import { RemoteProtocolError } from "../errors";
import type { Place } from "../planning/byte-ranges";
import type { Target } from "../types";

/** The version that an `open` names; a server answers another one with `unsupported-version`. */
export const VERSION = 1;

/** The WebSocket subprotocol that both sides agree on. */
export const SUBPROTOCOL = "lodestream.v1";

/** The most bytes of a container in one `segments`. A message cannot be interrupted: this is what a `stop` waits for. */
export const MAX_DATA = 64 * 1024;

/** The most bytes of a whole message, either way. */
export const MAX_MESSAGE = MAX_DATA + 1024;

/** The credit that every server keeps: what a slow reader has in front of it, and what arrives after a `stop`. */
export const BASE_CREDIT = 256 * 1024;

/** The most credit that a server keeps, if its header says so: enough for 640 Mbit/s over a round trip of 100 ms. */
export const MAX_CREDIT = 8 * 1024 * 1024;

/** What a client has outstanding at least, however slow the link is: below it, framing costs too much. */
export const MIN_WINDOW = 16 * 1024;

/** The most ranges of `open.held`: they fit into one message, and subtracting them is no work. */
export const MAX_HELD = 4096;

/** Error codes: the close code of the WebSocket after each, and its title. */
export const CODES: Readonly<Record<string, { readonly close: number; readonly title: string }>> = {
  "bad-message": { close: 4400, title: "Not a message of this protocol" },
  "out-of-turn": { close: 4400, title: "The message is not allowed now" },
  "no-token": { close: 4401, title: "A token is needed" },
  "bad-token": { close: 4401, title: "The token is unknown, expired or revoked" },
  "small-scope": { close: 4403, title: "The token's scope does not allow this" },
  "not-found": { close: 4404, title: "There is no such thing" },
  idle: { close: 4408, title: "The client was silent, or did not read, for too long" },
  "not-ready": { close: 4409, title: "The surface is still being built" },
  "other-container": { close: 4412, title: "The surface has another container than the one held" },
  "bad-held": { close: 4416, title: "The list of held slices is not valid" },
  failed: { close: 4409, title: "The surface could not be built" },
  waiting: { close: 4409, title: "The surface could not be built yet; it waits for a retry" },
  "bad-target": { close: 4422, title: "The surface cannot meet the target" },
  "unsupported-version": { close: 4426, title: "Another version of the protocol" },
  "too-many": { close: 4429, title: "The client has too much in progress" },
  "message-too-large": { close: 1009, title: "The message is too large" },
  damaged: { close: 4500, title: "The stored container is damaged" },
  busy: { close: 4503, title: "The server is busy; try again later" },
  internal: { close: 1011, title: "The server failed" },
  restarting: { close: 1012, title: "The server is restarting; try again" },
};

/** The other side sent something that the protocol does not allow; `code`, a key of `CODES`, is the answer to send. */
export class MessageError extends RemoteProtocolError {
  readonly code: string;

  constructor(code: string, message: string) {
    super(message);
    this.code = code;
  }
}

/** From the client: what it wants, what it holds, and its first credit. Sent first, and again after an `end`. */
export interface Open {
  readonly type: "open";
  /** `seconds` is not sent to the server. */
  readonly target: Target;
  /** First credit, in bytes of `segments.data`. */
  readonly credit: number;
  /**
   * Slices of the container that the client holds, at most `MAX_HELD`. After an `end`, if neither they nor `container`
   * are given, the slices sent over this connection count as held.
   */
  readonly held: readonly Place[];
  /** SHA-256 of the container that these slices belong to. */
  readonly container?: string | undefined;
  /** For a client that cannot send a header with the handshake, such as a browser; not allowed in an address. */
  readonly token?: string | undefined;
  /** True: of a window, the client knows bounds of errors, and takes the section that has them. */
  readonly window_errors?: boolean | undefined;
  /**
   * True: the client reads from the data where layers end, so it gets no `layer`, and `segments` that go on across their
   * ends once its credit is large.
   */
  readonly decodes?: boolean | undefined;
}

/** From the client: this many more bytes of `segments.data` may be sent. */
export interface Credit {
  readonly type: "credit";
  readonly bytes: number;
}

/** From the client: stop sending; only `end` may follow. */
export interface Stop {
  readonly type: "stop";
}

/** From the client: the answer to `end`; the server then closes. */
export interface Bye {
  readonly type: "bye";
}

/** From the server: which container is sent, and how much of it. */
export interface Header {
  readonly type: "header";
  /** SHA-256 of the container, 64 hexadecimal digits. */
  readonly container: string;
  /** Bytes of the whole container. */
  readonly size: number;
  /** Bytes of the surface that the target needs, including held ones; index and metadata are not counted. */
  readonly planned: number;
  /** Unit of relative tolerances: the range of the heights, or the diagonal of the bounding box. */
  readonly extent: number;
  readonly index: Place;
  readonly metadata: Place;
  /** True if the file is sent from its first byte on, then the metadata; false if the index comes first, then slices. */
  readonly prefix: boolean;
  /** The most credit that the server keeps for this stream; left out: `BASE_CREDIT`. */
  readonly credit?: number | undefined;
  /**
   * Of a window: the section with bounds of its errors, which comes behind the index, or a length of 0 where the container
   * has none. Left out: the server tells no errors of windows before their end.
   */
  readonly window_errors?: Place | undefined;
  /** True: the server stops by errors of channels. Left out: the target has none, or the server does not know them. */
  readonly channels?: boolean | undefined;
}

/** From the server: a slice of the container that starts at `offset`. */
export interface Segments {
  readonly type: "segments";
  readonly offset: number;
  readonly data: Uint8Array;
}

/**
 * From the server: a layer (quality order) or a level (level order) is complete with what was sent so far. A client that
 * decodes gets none, see `Open.decodes`.
 *
 * `rms` and `max` are NaN while the client has been sent more than belongs to the layer. Of a window they are bounds.
 */
export interface Layer {
  readonly type: "layer";
  readonly number: number;
  readonly level: number;
  readonly bytes: number;
  readonly rms: number;
  readonly max: number;
}

/** From the server: nothing more will be sent, and why: complete, level, rms, max, bytes or stopped. */
export interface End {
  readonly type: "end";
  readonly why: string;
}

/** From the server: it refuses, and closes the WebSocket with the code's close code. */
export interface ErrorMessage {
  readonly type: "error";
  readonly code: string;
  readonly title: string;
  readonly detail: string;
}

/** Any message. */
export type Event = Open | Credit | Stop | Bye | Header | Segments | Layer | End | ErrorMessage;

/** The name of a message. */
export type EventType = Event["type"];
