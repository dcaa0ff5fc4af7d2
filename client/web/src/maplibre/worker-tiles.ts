/** The page's side of the worker that makes tiles. */

import { errorFrom, plainError, UnavailableError } from "../errors";
import type { WorkerLike } from "../transfer/channel";
import type { FieldSource } from "./height-field";
import type { FromTiles, ToTiles } from "./messages";
import type { ForeignTransform } from "./projection";
import type { Tile } from "./tile-grid";
import type { Described, Look, TileMaker } from "./tiles";

interface Waiting {
  resolve(answer: unknown): void;
  reject(reason: unknown): void;
}

/** Tiles that are made in a worker. */
export class WorkerTiles implements TileMaker {
  private readonly waiting = new Map<number, Waiting>();
  private asked = 0;
  private gone: Error | undefined;

  /** @param foreign Is called on this thread. */
  constructor(
    private readonly worker: WorkerLike,
    private readonly foreign: ForeignTransform,
    cacheBytes: number,
  ) {
    worker.onmessage = ({ data }: MessageEvent<FromTiles>) => this.take(data);
    worker.onerror = (event) => {
      this.gone = new UnavailableError(`the worker failed: ${event.message || "no reason given"}`);
      for (const { reject } of this.waiting.values()) reject(this.gone);
      this.waiting.clear();
    };
    this.post({ kind: "begin", cacheBytes });
  }

  describe(source: FieldSource, look: Look, signal: AbortSignal): Promise<Described> {
    return this.ask((id) => ({ kind: "describe", id, source, look }), signal);
  }

  tile(source: FieldSource, look: Look, tile: Tile, signal: AbortSignal): Promise<Uint8ClampedArray<ArrayBuffer>> {
    return this.ask((id) => ({ kind: "tile", id, source, look, tile }), signal);
  }

  private ask<Answer>(question: (id: number) => ToTiles, signal: AbortSignal): Promise<Answer> {
    return new Promise((resolve, reject) => {
      signal.throwIfAborted();
      if (this.gone !== undefined) throw this.gone;
      this.asked += 1;
      const id = this.asked;
      const leave = (): void => {
        this.waiting.delete(id);
        this.post({ kind: "leave", id });
        reject(signal.reason);
      };
      signal.addEventListener("abort", leave);
      const stay = (): void => signal.removeEventListener("abort", leave);
      this.waiting.set(id, {
        resolve: (answer) => {
          stay();
          resolve(answer as Answer);
        },
        reject: (reason) => {
          stay();
          reject(reason);
        },
      });
      this.post(question(id));
    });
  }

  private take(message: FromTiles): void {
    if (message.kind === "transform") {
      void this.transform(message);
      return;
    }
    const waiting = this.waiting.get(message.id);
    this.waiting.delete(message.id);
    if (message.kind === "refused") waiting?.reject(errorFrom(message.error));
    else waiting?.resolve(message.answer);
  }

  private async transform({ id, crs, places, back }: FromTiles & { kind: "transform" }): Promise<void> {
    try {
      const found = await this.foreign(crs, places, back);
      this.post({ kind: "transformed", id, places: found }, [found.buffer as ArrayBuffer]);
    } catch (error) {
      this.post({ kind: "not transformed", id, error: plainError(error) });
    }
  }

  private post(message: ToTiles, transfer: Transferable[] = []): void {
    this.worker.postMessage(message, transfer);
  }
}
