/** The caller's end: a decoder that lives in a worker. */
import type { Metadata } from "../../container/sections";
import { errorFrom, UnavailableError } from "../../errors";
import { loadKernels } from "../../kernels/instance";
import type { Region, Surface, ViewInfo } from "../../types";
import type { DecoderOptions } from "../decoder";
import type { Answer, Call, Listener, Port, Request } from "./messages";

/** A state of a surface whose points a worker computes on request. */
export interface RemoteView extends ViewInfo {
  /** The state as a surface, at full resolution or at a coarser level, see `View.surface`. */
  surface(level?: number): Promise<Surface>;
  /** A window at full resolution or at a coarser level, see `View.window`. */
  window(region: Region, level?: number): Promise<Surface>;
}

/** A `Decoder` in a worker, at the other end of whose port is `serveDecoder`. Calls are done in the order made. */
export class RemoteDecoder {
  /** All states so far. */
  readonly layers: RemoteView[] = [];
  readonly #port: Port;
  readonly #waiting = new Map<number, { resolve: (answer: Answer) => void; reject: (error: Error) => void }>();
  readonly #listener: Listener = ({ data }) => this.#take(data as Answer);
  #metadata: Metadata | null = null;
  #next = 0;
  #closed = false;

  private constructor(port: Port) {
    this.#port = port;
    port.addEventListener("message", this.#listener);
  }

  /** Begin to decode in a worker; one surface at a time. */
  static async open(port: Port, options: DecoderOptions = {}): Promise<RemoteDecoder> {
    const decoder = new RemoteDecoder(port);
    await decoder.#call({ do: "open", options, module: await loadKernels() });
    return decoder;
  }

  /** The metadata, once they have come. */
  get metadata(): Metadata | null {
    return this.#metadata;
  }

  /** Whether the whole surface has arrived. */
  get complete(): boolean {
    return this.layers.at(-1)?.complete ?? false;
  }

  /** As `Decoder.feed`; the memory of `data` is given away. */
  async feed(data: Uint8Array): Promise<RemoteView[]> {
    const before = this.layers.length;
    await this.#call({ do: "feed", data }, data);
    return this.layers.slice(before);
  }

  /** As `Decoder.feedAt`; the memory of `data` is given away. */
  async feedAt(offset: number, data: Uint8Array): Promise<RemoteView[]> {
    const before = this.layers.length;
    await this.#call({ do: "feedAt", offset, data }, data);
    return this.layers.slice(before);
  }

  /** As `Decoder.focus`. */
  async focus(region: Region | null): Promise<void> {
    await this.#call({ do: "focus", region });
  }

  /** As `Decoder.finish`. */
  async finish(): Promise<void> {
    await this.#call({ do: "finish" });
  }

  /** Listen no more, so that the worker can decode another surface, or end; calls that wait are refused. */
  close(): void {
    this.#closed = true;
    this.#port.removeEventListener("message", this.#listener);
    for (const { reject } of this.#waiting.values()) reject(closed());
    this.#waiting.clear();
  }

  #call(call: Call, data?: Uint8Array): Promise<Answer> {
    if (this.#closed) return Promise.reject(closed());
    const id = this.#next++;
    const request: Request = { id, call };
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject });
      // Memory that others see too cannot be given away; it is copied.
      const own = data?.buffer instanceof ArrayBuffer && data.byteLength === data.buffer.byteLength;
      this.#port.postMessage(request, own ? [data.buffer as ArrayBuffer] : []);
    });
  }

  #take(answer: Answer): void {
    const waiting = this.#waiting.get(answer.id);
    if (!waiting) return;
    this.#waiting.delete(answer.id);
    this.#metadata = answer.metadata;
    for (const info of answer.views) this.#add(info);
    if (answer.error) waiting.reject(errorFrom(answer.error));
    else waiting.resolve(answer);
  }

  #add(info: ViewInfo): void {
    const view = this.layers.length;
    const shown = async (call: Call): Promise<Surface> => {
      const { surface } = await this.#call(call);
      if (surface === null) throw new Error("expected a surface, got none");
      return surface;
    };
    this.layers.push({
      ...info,
      surface: (level) => shown({ do: "surface", view, level: level ?? null }),
      window: (region, level) => shown({ do: "window", view, region, level: level ?? null }),
    });
  }
}

function closed(): Error {
  return new UnavailableError("expected a decoder that is open, got one that has been closed");
}
