/** The way to a `Host`: in a worker, or in the same thread. */

import { errorFrom, type PlainError, plainError, UnavailableError } from "../errors";
import type { Surface } from "../types";
import { Host, type Platform, type Questions, type Told } from "./host";

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

/** A host in the same thread. */
export class LocalChannel implements Channel {
  private readonly host: Host;
  private over = false;

  constructor(tell: (told: Told) => void, platform: Platform) {
    this.host = new Host((told) => {
      if (!this.over) tell(told);
    }, platform);
  }

  async ask<Name extends keyof Questions>(
    name: Name,
    ...given: Parameters<Questions[Name]>
  ): Promise<Awaited<ReturnType<Questions[Name]>>> {
    if (this.over) throw new UnavailableError("expected a stream that is open, got one that has been closed");
    return answerOf(this.host, name, given) as Promise<Awaited<ReturnType<Questions[Name]>>>;
  }

  end(): void {
    this.over = true;
    void this.host.close().catch(() => undefined);
  }
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

/** Let a host answer what is posted to a worker. */
export function serveHost(post: (message: FromHost, transfer: Transferable[]) => void, platform: Platform = {}) {
  const host = new Host(
    (told) => post({ told }, told.kind === "bytes" ? [told.data.buffer as ArrayBuffer] : []),
    platform,
  );
  return async ({ id, name, given }: Asked): Promise<void> => {
    try {
      const answer = await answerOf(host, name, given);
      const made = name === "surface" || name === "window" ? buffersOf(answer as Surface) : [];
      post({ id, answer }, made);
    } catch (error) {
      post({ id, error: plainError(error) }, []);
    }
  };
}

async function answerOf(host: Host, name: keyof Questions, given: readonly unknown[]): Promise<unknown> {
  return (host[name] as (...given: readonly unknown[]) => unknown)(...given);
}

/** The memory of a surface's arrays that hold nothing else, and are made for whoever asks. */
function buffersOf(surface: Surface): ArrayBuffer[] {
  const found = new Set<ArrayBuffer>();
  for (const { points, attributes } of surface.blocks) {
    for (const { values } of [points, ...attributes.values()]) {
      const { buffer } = values;
      if (buffer instanceof ArrayBuffer && buffer.byteLength === values.byteLength) found.add(buffer);
    }
  }
  return [...found];
}
