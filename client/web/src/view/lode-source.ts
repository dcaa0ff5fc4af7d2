/** The source of containers: a surface of a server, or a container file of any host. Everything happens in a worker. */

import type { PartReader } from "../transfer/parts";
import type { DetailWindow, MomentGrids, NodeValues, Region, Source, SourceEvents, Target } from "./source";
import type { FromSource, Question, ToSource } from "./source-messages";
import SourceWorker from "./source-worker?worker&inline";

interface Waiting {
  resolve(answer: FromSource): void;
  reject(error: Error): void;
}

/** A surface that is received and decoded in a worker. */
export class LodeSource implements Source {
  private readonly worker = new SourceWorker();
  private readonly waiting = new Map<number, Waiting>();
  private asked = 0;

  /**
   * @param place - Absolute address; or what gives the bytes, which is asked on the page's thread.
   * @param token - For a server that wants one.
   */
  constructor(
    private readonly place: string | PartReader,
    private readonly token: string | null,
  ) {}

  start(events: SourceEvents): void {
    this.worker.onmessage = ({ data }: MessageEvent<FromSource>) => {
      if (data.kind === "info") events.info(data.info);
      else if (data.kind === "moment") events.moment(data.moment);
      else if (data.kind === "progress") events.progress(data.progress);
      else if (data.kind === "refined") events.refined();
      else if (data.kind === "read") void this.give(data.id, data.offset, data.length);
      else {
        const waiting = this.waiting.get(data.id);
        this.waiting.delete(data.id);
        if (data.kind === "refused") waiting?.reject(new Error(data.detail));
        else waiting?.resolve(data);
      }
    };
    this.worker.onerror = (event) => {
      const detail = event.message || "the worker that decodes could not be started";
      events.progress({ state: "failed", bytes: 0, planned: 0, rate: 0, detail });
    };
    this.post({ kind: "open", url: typeof this.place === "string" ? this.place : null, token: this.token });
  }

  async grids(moment: number | null, level: number, window: DetailWindow | null): Promise<MomentGrids> {
    const answer = await this.ask({ kind: "grids", moment, level, window });
    if (answer.kind !== "grids") throw new Error(`expected grids, got ${answer.kind}`);
    return answer.picture;
  }

  async valuesAt(moment: number, block: number, row: number, column: number): Promise<NodeValues> {
    const answer = await this.ask({ kind: "values", moment, block, row, column });
    if (answer.kind !== "values") throw new Error(`expected values, got ${answer.kind}`);
    return answer.values;
  }

  focus(region: Region | null): void {
    this.post({ kind: "focus", region });
  }

  setTarget(target: Target): void {
    this.post({ kind: "target", target });
  }

  stop(): void {
    this.post({ kind: "stop" });
  }

  resume(): void {
    this.post({ kind: "resume" });
  }

  throttle(rate: number | null): void {
    this.post({ kind: "throttle", rate });
  }

  close(): void {
    this.worker.terminate();
    for (const { reject } of this.waiting.values()) reject(new Error("the surface was closed"));
    this.waiting.clear();
  }

  private post(message: ToSource, transfer: Transferable[] = []): void {
    this.worker.postMessage(message, transfer);
  }

  /** Gives the worker bytes that it has asked for. */
  private async give(id: number, offset: number, length: number): Promise<void> {
    if (typeof this.place === "string") return;
    try {
      const part = await this.place(offset, length);
      // What was made for this answer alone is handed over; a piece of something larger is copied.
      const { buffer } = part.data;
      const own = buffer instanceof ArrayBuffer && buffer.byteLength === part.data.byteLength;
      this.post({ kind: "part", id, part }, own ? [buffer] : []);
    } catch (error) {
      const { message: detail = String(error), code } = (error ?? {}) as { message?: string; code?: unknown };
      this.post({ kind: "no part", id, detail, code: typeof code === "string" ? code : "" });
    }
  }

  private ask(question: Question): Promise<FromSource> {
    this.asked += 1;
    const id = this.asked;
    this.post({ kind: "question", id, question });
    return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
  }
}
