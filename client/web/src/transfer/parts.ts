/** A container whose bytes somebody gives by random access, such as a kernel of a notebook, as a source of ranges. */

import type { RangeRequest } from "./range-download";
import type { RangeAnswer, RangeSource } from "./range-sources";

/** Bytes of a container, as they are given. */
export interface Part {
  /** From the offset that was asked for on: as many as were asked for, or fewer where the container ends. */
  readonly data: Uint8Array;
  /** Bytes of the container. */
  readonly size: number;
  /** Changes when the container does. */
  readonly tag: string;
}

/** Gives at most `length` bytes, up to `PART`, from `offset` on. @throws Error if they cannot be had. */
export type PartReader = (offset: number, length: number) => Promise<Part>;

/** The most bytes that are asked for at once; of each range, two parts are under way at most. */
export const PART = 128 * 1024;

/**
 * Ranges in parts. The next part is asked for when the one before is handed on, so what is under way stays small however
 * slowly bytes are used, and nothing more is asked for once a range is left.
 */
export class PartRanges implements RangeSource {
  constructor(private readonly read: PartReader) {}

  async ask(request: RangeRequest, _patience: () => number, signal: AbortSignal): Promise<RangeAnswer> {
    const { offset, end } = request;
    const ask = (from: number, past: number): Promise<Part> => {
      const asked = this.read(from, Math.min(PART, past - from));
      asked.catch(() => undefined); // whoever reads is told; what is left is of no interest
      return asked;
    };
    let next: Promise<Part> | undefined = ask(offset, end);
    const { size, tag } = await next;
    const past = Math.min(end, size);
    const headers = new Map([
      ["content-range", `bytes ${offset}-${past - 1}/${size}`],
      ["etag", JSON.stringify(tag)],
    ]);
    let position = offset;
    const read = async (): Promise<Uint8Array | undefined> => {
      if (next === undefined || signal.aborted) return undefined;
      const { data } = await next;
      position += data.length;
      // Fewer bytes than asked for end the range, which says that some are missing.
      const more = position < past && data.length > 0 && !signal.aborted;
      next = more ? ask(position, past) : undefined;
      return data;
    };
    const status = past <= offset ? 416 : 206;
    return { status, headers: { get: (name) => headers.get(name.toLowerCase()) ?? null }, read };
  }
}
