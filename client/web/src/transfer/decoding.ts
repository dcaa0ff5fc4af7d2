/**
 * What a stream needs of a decoder. `Decoder` of `decoding/` is one; tests have others.
 *
 * The stream and its decoder live in the same thread, a worker where there is one: whether a byte is needed depends on
 * what has been decoded, and credit is granted for what has been used.
 */

import type { Capacity } from "../container/capacity";
import type { Header } from "../container/header";
import type { Index } from "../container/model";
import type { Region, ViewInfo } from "../types";

/** Decodes a container as its bytes come, and gives a view for each state whose errors are known. */
export interface StreamDecoder<View extends ViewInfo> {
  /** What the header says, once it and the masks after it have come. */
  readonly header: Header | null;
  /** The index, if it has been given to the decoder. */
  readonly index: Index | null;
  /** The states so far. */
  readonly layers: readonly View[];
  /** Whether the whole surface has arrived; metadata and index may still be missing. */
  readonly complete: boolean;
  /** How much memory may be taken; `take` counts, and throws `TooLargeError` beyond `bytes`. */
  readonly capacity: Capacity;

  /**
   * Decode a slice of the container that starts at `offset`; returns the views that it completes.
   *
   * Slices come in the order of a plan. They may be cut anywhere.
   */
  feedAt(offset: number, data: Uint8Array): View[];

  /** Announce another order of the bytes: first what a region needs; with null, the plan's own order. */
  focus(region: Region | null): void;
}
