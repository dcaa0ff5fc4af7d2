/** What the transports of a surface, a WebSocket and HTTP Range, need of the stream that uses them. */

import type { ViewInfo } from "../types";
import type { ReceiverState } from "./receiver-state";
import type { Waiting } from "./waiting";

/** A stream as its transport sees it. */
export interface Journey<View extends ViewInfo> {
  /** What has arrived so far. */
  readonly reception: ReceiverState<View>;
  /** Woken when `stopped` or `turns` changes, or the stream is to be closed. */
  readonly waiting: Waiting;
  /** Whether this side has stopped. */
  readonly stopped: boolean;
  /** How often the target has changed. */
  readonly turns: number;
  /** Seconds without data after which a connection counts as lost. */
  patience(): number;
  /** Declare a connection, or a request, that has been answered as expected. */
  met(): void;
  /** Bytes to take at once, so that at a limited rate they come one after another. */
  readonly portion: number;
  /** Wait as long as so many bytes take at the rate allowed. */
  pace(size: number): Promise<void>;
  /** Take bytes, whose views are handed on. */
  take(receive: () => View[]): void;
  /** Wait until the views that were handed on have been taken. */
  room(): Promise<void>;
}
