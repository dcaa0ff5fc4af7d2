/** What a stream may be told, and what it tells. */

import type { Ended } from "../planning/plan";
import type { RangeLimits } from "./range-download";
import type { Sink } from "./receiver-state";
import type { SocketClass } from "./socket";
import type { Store } from "./store";
import type { Pauses, Transport, UsedTransport } from "./transports";

/** What a stream is doing. */
export type Phase = "idle" | "connecting" | "streaming" | "reconnecting" | "ended";

/** The state of a stream. */
export interface StreamState {
  readonly phase: Phase;
  /** The transport in use: a WebSocket, HTTP Range, or a file of this machine. */
  readonly transport: UsedTransport | "file";
  /** While reconnecting: what became of the last connection, and the seconds until the next attempt. */
  readonly problem?: string;
  readonly pause?: number;
  /** Once ended: why. */
  readonly ended?: Ended;
}

/** How far a stream has come. */
export interface Progress {
  /** Bytes of the surface that are cached, and that the target needs; undefined until that is known. */
  readonly received: number;
  readonly planned: number | undefined;
  /** Bytes of the container, once they are known. */
  readonly size: number | undefined;
  /** Bytes of all messages and answers received. */
  readonly wireBytes: number;
  /** Bytes of the container received. */
  readonly dataBytes: number;
  /** Seconds since the stream began. */
  readonly seconds: number;
  /** Number of connections so far; over HTTP, number of requests. */
  readonly connections: number;
}

/** Options of a stream that can be sent from one thread to another; times in seconds. */
export interface PlainStreamOptions {
  /** For a server that needs one. It goes to the URL's own origin only, and never into an address. */
  readonly token?: string | undefined;
  /** `auto`: a WebSocket, or HTTP Range where none gets through. */
  readonly transport?: Transport | undefined;
  /** Without data for so long, a connection counts as lost; 30. */
  readonly silence?: number | undefined;
  /** After a connection was lost: without data for so long, the stream gives up with the last error; 60. */
  readonly deadline?: number | undefined;
  /** How long the other side may take to close; 5. */
  readonly closeTimeout?: number | undefined;
  /** Bytes per second, to feel a slow link. */
  readonly limitRate?: number | undefined;
  /** Bytes that may be in flight over a WebSocket, up to 8,388,608; left out: measured from the link. */
  readonly window?: number | undefined;
  /** Give only the newest view to whoever is slower than the stream, which then does not wait. */
  readonly latest?: boolean | undefined;
  /** SHA-256 and size of the container that bytes are cached of. */
  readonly container?: string | undefined;
  readonly size?: number | undefined;
  /** Seconds between attempts. */
  readonly pauses?: Pauses | undefined;
}

/** Options of a stream. */
export interface StreamOptions extends PlainStreamOptions {
  /** Called when the state changes. */
  readonly onState?: ((state: StreamState) => void) | undefined;
  /** Called when bytes have come. */
  readonly onProgress?: ((progress: Progress) => void) | undefined;
  /** Called with bytes of the container that had not come before; by then it is known which container it is. */
  readonly onBytes?: Sink | undefined;
  /** Bytes that are cached already, and where others are kept. */
  readonly store?: Store | undefined;
  /** What tells the version of the file that they belong to: its entity tag, or else its date. */
  readonly version?: string | undefined;
  /** How a file is asked for by Range; left out: whatever takes the least time. */
  readonly ranges?: RangeLimits | undefined;
  /** In place of the platform's own; Node 20 has no WebSocket. */
  readonly WebSocket?: SocketClass | undefined;
  readonly fetch?: typeof globalThis.fetch | undefined;
}
