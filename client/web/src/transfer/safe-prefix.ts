/**
 * The beginning of a container before its index has come: what a receiver may decode of it at once.
 *
 * A plan in the file's order has every layer up to the one that meets the target, and layers carry their errors. So a
 * layer that ends within the bytes allowed, and stands behind none that meets the target, is in the plan, come what may.
 */

import { sectionExtent } from "../container/frames";
import { KIND, SIGNATURE_LENGTH } from "../container/sections";
import { ErrorLimits } from "../planning/limits";
import type { Target, ViewInfo } from "../types";
import type { StreamDecoder } from "./decoding";

const LONGEST_START = 10;
const PREFIX_KINDS: readonly number[] = [KIND.header, KIND.masks, KIND.keptMasks, KIND.layer];

/** Whether what the target needs is a prefix of the file, and its metadata. */
export function inFileOrder(target: Target): boolean {
  const elsewhere = [target.level, target.region, target.attributes, target.first];
  return target.order !== "level" && elsewhere.every((each) => each === undefined);
}

/**
 * How many bytes from `position` on, where a section begins, the plan is sure to have; 0 where none, or not yet.
 *
 * @param target One that is `inFileOrder`.
 * @param decoder It has been given everything before `position`, and nothing else.
 * @param position 0, or the end of what was sure before.
 * @param run How many bytes have come from there on.
 * @param read Gives bytes that have come.
 * @throws CorruptStreamError when no section begins there.
 * @throws OptionError when the surface has no channel that the target names.
 */
export function sure(
  target: Target,
  decoder: StreamDecoder<ViewInfo>,
  position: number,
  run: number,
  read: (offset: number, length: number) => Uint8Array,
): number {
  if (position === 0) return run >= SIGNATURE_LENGTH ? SIGNATURE_LENGTH : 0;
  const start = read(position, Math.min(run, LONGEST_START));
  const extent = sectionExtent(start, position);
  if (extent === null || run < extent.end || !PREFIX_KINDS.includes(start[0]!)) return 0;
  return start[0] === KIND.layer && met(target, decoder, position + extent.end) ? 0 : extent.end;
}

/** Whether the target is met without the layer that ends there. */
function met(target: Target, decoder: StreamDecoder<ViewInfo>, end: number): boolean {
  if (target.maxBytes !== undefined && end > target.maxBytes) return true;
  const view = decoder.layers[decoder.layers.length - 1];
  if (decoder.header === null) return false;
  const limits = new ErrorLimits(target, decoder.header);
  return view !== undefined && limits.met(view) !== undefined;
}
