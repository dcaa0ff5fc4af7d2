/** The parts of a plan. */

import type { ByteRange, ChannelErrors } from "../types";

/** Why a stream ends; a plan knows the first six, the others happen on the way. */
export type Ended = "complete" | "level" | "rms" | "max" | "channels" | "bytes" | "seconds" | "stopped" | "truncated";

/**
 * A state that the receiver reaches when it has received `sent` bytes of the plan's ranges.
 *
 * `number` is that of the layer (quality order) or level (level order). `bytes` counts what is cached of the container.
 * Errors are NaN where they are not known.
 */
export interface Mark {
  readonly sent: number;
  readonly number: number;
  readonly level: number;
  readonly bytes: number;
  readonly rms: number;
  readonly maxError: number;
  /** Errors of each channel; empty where there is one, or where they are not known. */
  readonly channels: ChannelErrors;
}

/** Slices of a container in sending order, without what is cached. */
export interface Plan {
  /** Service slices that must come first: the index, if segments are sent without the tables of their layers. */
  readonly before: readonly ByteRange[];
  /** Slices of the surface. */
  readonly ranges: readonly ByteRange[];
  /** The metadata. */
  readonly after: readonly ByteRange[];
  /** States on the way, the last one at the end; states with a `sent` of 0 are cached already. */
  readonly marks: readonly Mark[];
  /** Why the plan ends. */
  readonly ended: Ended;
  /** Whether all `ranges` together are a prefix of the file, which needs no index. */
  readonly prefix: boolean;
}

/** The state at the end of a plan; its `bytes` are those of the surface's slices, sent or cached. */
export function endOf(plan: Plan): Mark {
  return plan.marks[plan.marks.length - 1]!;
}
