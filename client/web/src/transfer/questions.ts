/** What is asked of a `Host` and what it answers, all of which can be posted from one thread to another. */

import type { BlockShape } from "../container/arrangement";
import type { Plane } from "../container/extras";
import type { Metadata } from "../container/sections";
import type { TargetOptions } from "../planning/target";
import type { AttributeKind, DType, Region, Surface, ViewInfo } from "../types";
import type { PlainStreamOptions, Progress, StreamState } from "./options";
import type { Price } from "./prices";
import type { SocketClass } from "./socket";

/** Bytes of a container that were received before, to go on with. */
export interface Kept {
  /** SHA-256 of the container, if it is known. */
  readonly container: string | undefined;
  /** Bytes of the container. */
  readonly size: number | undefined;
  /** What tells this version of a file on a web server from others: its entity tag, or else its date. */
  readonly version: string | undefined;
  /** Runs of its bytes, by where they begin, in any order. */
  readonly slices: readonly (readonly [offset: number, data: Uint8Array])[];
}

/** What is known of a surface before its values. */
export interface Description {
  readonly blocks: readonly BlockShape[];
  /** Whether sides of the blocks are joined. */
  readonly joined: boolean;
  /** Number of the finest level. */
  readonly levels: number;
  /** Range of the heights, or diagonal of the box of the points: what relative errors refer to. */
  readonly extent: number;
  /** Type of the points, and numbers at a point. */
  readonly dtype: DType;
  readonly pointChannels: number;
  readonly attributes: readonly AttributeKind[];
  /** Rules of x and y, of heights that came with them. */
  readonly plane: Plane | null;
  /** The complete stream restores every value bit for bit. */
  readonly exact: boolean;
  /** Of each block, points that are not valid; empty where all are. */
  readonly holes: readonly number[];
  /** SHA-256 and size of the container, as far as they are known. */
  readonly container: string | undefined;
  readonly size: number | undefined;
  /** Null before they have come: they stand at the end of a stream. */
  readonly metadata: Metadata | null;
  /** Null while the index is not known, see `SurfaceStream.prices`. */
  readonly prices: readonly Price[] | null;
}

/** What a stream is made of. */
export interface Opening {
  readonly source: string | Blob;
  readonly target: TargetOptions;
  readonly options: PlainStreamOptions;
  /** Limit on the memory of the surface, in vertices. */
  readonly maxVertices: number | undefined;
  /** Bytes to go on with; with `keep`, all bytes are kept for a later stream. */
  readonly kept: Kept | undefined;
  readonly keep: boolean;
  /** Whether `bytes` are told. */
  readonly tellBytes: boolean;
}

/** What the far side tells by itself. */
export type Told =
  | { readonly kind: "state"; readonly state: StreamState; readonly progress: Progress }
  | { readonly kind: "progress"; readonly progress: Progress }
  | { readonly kind: "description"; readonly description: Description }
  | { readonly kind: "bytes"; readonly offset: number; readonly data: Uint8Array };

/** What can be asked: the arguments of each question, and its answer. */
export interface Questions {
  open(opening: Opening): void;
  next(): Promise<{ readonly number: number; readonly info: ViewInfo } | null>;
  stop(): Promise<void>;
  close(): Promise<void>;
  focus(region: Region | undefined): void;
  aim(target: TargetOptions): void;
  throttle(rate: number | undefined): void;
  surface(view: number, level: number | undefined): Promise<Surface>;
  window(view: number, region: Region, level: number | undefined): Surface;
  prices(): Promise<readonly Price[]>;
  kept(): Kept;
}

/** Parts of the platform that tests replace. */
export interface Platform {
  readonly WebSocket?: SocketClass | undefined;
  readonly fetch?: typeof globalThis.fetch | undefined;
}
