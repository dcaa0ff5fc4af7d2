/** The worker's side of bytes that the page gives: questions out, parts in. */

import { LodestreamError, RemoteError } from "../errors";
import type { Part, PartReader } from "../transfer/parts";
import type { FromSource, ToSource } from "./source-messages";

interface Waiting {
  readonly offset: number;
  readonly length: number;
  resolve(part: Part): void;
  reject(error: Error): void;
}

/** Parts of a container that the page is asked for. */
export class AskedParts {
  private readonly waiting = new Map<number, Waiting>();
  private asked = 0;

  /** @param post - Sends a question to the page. */
  constructor(private readonly post: (message: FromSource) => void) {}

  /** See `PartReader`. */
  readonly read: PartReader = (offset, length) =>
    new Promise((resolve, reject) => {
      this.asked += 1;
      this.waiting.set(this.asked, { offset, length, resolve, reject });
      this.post({ kind: "read", id: this.asked, offset, length });
    });

  /** Takes an answer. */
  take(answer: Extract<ToSource, { kind: "part" | "no part" }>): void {
    const waiting = this.waiting.get(answer.id);
    this.waiting.delete(answer.id);
    if (waiting === undefined) return;
    if (answer.kind === "no part") {
      const { code, detail } = answer;
      waiting.reject(code === "" ? new LodestreamError(detail) : new RemoteError(code, detail));
      return;
    }
    const { data, size } = answer.part;
    const most = Math.max(Math.min(waiting.length, size - waiting.offset), 0);
    if (data.length <= most) waiting.resolve(answer.part);
    else waiting.reject(new LodestreamError(`expected at most ${most} bytes of the container, got ${data.length}`));
  }
}
