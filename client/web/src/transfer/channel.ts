/** The way to a `Host`: in a worker, or in the same thread. */

import { errorFrom, type PlainError, UnavailableError } from "../errors";
import type { Questions, Told } from "./questions";

/** A question on its way to the host. */
export interface Asked {
  readonly id: number;
  readonly name: keyof Questions;
  readonly given: readonly unknown[];
}

/** An answer, or something that the host tells by itself. */
export type FromHost =
  | { readonly id: number; readonly answer: unknown }
  | { readonly id: number; readonly error: PlainError }
  | { readonly told: Told };

/** What asks a host. */
export interface Channel {
  /**
   * Ask a question.
   *
   * @throws LodestreamError what the host throws, or `UnavailableError` if it is gone.
   */
  ask<Name extends keyof Questions>(
    name: Name,
    ...given: Parameters<Questions[Name]>
  ): Promise<Awaited<ReturnType<Questions[Name]>>>;
  /** End the host; what has been asked of it is not answered any more, and nothing is told. */
  end(): void;
}

/** What a worker is to its channel: `Worker`, or what tests put in its place. */
export interface WorkerLike {
  postMessage(message: unknown, transfer?: Transferable[]): void;
  terminate(): unknown;
  onmessage: ((event: MessageEvent) => void) | null;
  onerror: ((event: ErrorEvent) => void) | null;
}

/** A host in a worker. */
export class WorkerChannel implements Channel {
  private readonly waiting = new Map<number, { resolve(answer: never): void; reject(error: Error): void }>();
  private asked = 0;
  private gone: Error | undefined;

  constructor(
    private readonly worker: WorkerLike,
    tell: (told: Told) => void,
  ) {
    worker.onmessage = ({ data }: MessageEvent<FromHost>) => {
      if ("told" in data) {
        if (this.gone === undefined) tell(data.told);
        return;
      }
      const waiting = this.waiting.get(data.id);
      this.waiting.delete(data.id);
      if ("error" in data) waiting?.reject(errorFrom(data.error));
      else waiting?.resolve(data.answer as never);
    };
    worker.onerror = (event) =>
      this.fail(new UnavailableError(`the worker failed: ${event.message || "no reason given"}`));
  }

  ask<Name extends keyof Questions>(
    name: Name,
    ...given: Parameters<Questions[Name]>
  ): Promise<Awaited<ReturnType<Questions[Name]>>> {
    return new Promise((resolve, reject) => {
      if (this.gone !== undefined) {
        reject(this.gone);
        return;
      }
      const id = ++this.asked;
      this.waiting.set(id, { resolve, reject });
      this.worker.postMessage({ id, name, given } satisfies Asked);
    });
  }

  end(): void {
    this.fail(new UnavailableError("expected a stream that is open, got one that has been closed"));
    this.worker.terminate();
  }

  private fail(error: Error): void {
    this.gone ??= error;
    for (const { reject } of this.waiting.values()) reject(error);
    this.waiting.clear();
  }
}
