/** What a container may have at most, so that its index and description stay small (docs/format.md, section 14). */
import { CorruptStreamError } from "../errors";

export const LIMITS = {
  layers: 1024,
  /** Of the points and of the attributes together. */
  channels: 4096,
  /** Errors of single channels that layers and levels carry: channels times layers and levels. */
  errors: 2 ** 16,
  blocks: 2 ** 14,
  patches: 2 ** 16,
  interfaces: 2 ** 16,
  /** Bytes of the names of attributes in UTF-8, counted once for each channel. */
  names: 2 ** 16,
  /** Bytes of the extras: names, the rules of a plane, joints. */
  extras: 2 ** 22,
  codecs: 64,
  /** Optional sections. */
  optional: 256,
} as const;

/** Refuse more of something than a container may have; `offset` is where it tells the count. */
export function checkCount(count: number, most: number, what: string, offset: number): void {
  if (count > most) throw new CorruptStreamError(`expected at most ${most} ${what}, got ${count}`, offset);
}

/** Refuse a layer without segments beside others; `filled` says of some of the layers whether they have any. */
export function checkFilled(filled: readonly boolean[], layers: number, offset: number): void {
  if (layers > 1 && filled.includes(false)) {
    throw new CorruptStreamError(`expected segments in each of ${layers} layers, got a layer without`, offset);
  }
}
