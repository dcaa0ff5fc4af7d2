/** Questions to the kernel over the widget's comm, and what it says by itself. */

import type { Part } from "../transfer/parts";
import { type Buffers, bytesOf, type Model } from "./model";

/** Why the kernel gives no bytes; `code`: a machine's word for it, see the errors of `client/web/src/errors.ts`. */
export class Refused extends Error {
  constructor(
    message: string,
    readonly code: string,
  ) {
    super(message);
  }
}

interface Answer {
  readonly content: Readonly<Record<string, unknown>>;
  readonly bytes: Uint8Array;
}

interface Waiting {
  resolve(answer: Answer): void;
  reject(error: Error): void;
}

/**
 * One place where a widget is shown. All of them hear all messages of the kernel, so questions carry a name of the
 * place beside their number.
 */
export class Comm {
  private readonly place = crypto.getRandomValues(new Uint32Array(2)).join("-");
  private readonly waiting = new Map<string, Waiting>();
  private asked = 0;

  /** @param told - Takes commands of the kernel, which are meant for all places. */
  constructor(
    private readonly model: Model,
    private readonly told: (command: string) => void,
  ) {
    model.on("msg:custom", this.take);
    // Jupyter's word for a kernel that died or was restarted. One that is busy answers later, however long it takes.
    model.on("comm_live_update", this.lose);
  }

  /** Bytes of the container, see `PartReader`. @throws Refused */
  readonly read = async (offset: number, length: number): Promise<Part> => {
    const { content, bytes } = await this.ask({ kind: "read", offset, length });
    return { data: bytes, size: Number(content.size), tag: String(content.tag) };
  };

  /** The program that shows surfaces, as the kernel has it. @throws Refused */
  async program(): Promise<Uint8Array> {
    return (await this.ask({ kind: "program" })).bytes;
  }

  /** Ends: what is waited for does not come. */
  close(): void {
    this.model.off("msg:custom", this.take);
    this.model.off("comm_live_update", this.lose);
    this.refuseAll("the widget was closed");
  }

  private readonly lose = (): void => this.refuseAll("the kernel is gone: run the cell again");

  private refuseAll(why: string): void {
    for (const { reject } of this.waiting.values()) reject(new Refused(why, ""));
    this.waiting.clear();
  }

  private ask(question: Readonly<Record<string, unknown>>): Promise<Answer> {
    this.asked += 1;
    const id = `${this.place}:${this.asked}`;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.model.send({ ...question, id });
    });
  }

  private readonly take = (content: Readonly<Record<string, unknown>>, buffers?: Buffers): void => {
    if (content.kind === "command") {
      this.told(String(content.command));
      return;
    }
    const waiting = this.waiting.get(String(content.id));
    if (waiting === undefined) return;
    this.waiting.delete(String(content.id));
    try {
      if (content.kind === "refused") throw new Refused(String(content.detail), String(content.code));
      waiting.resolve({ content, bytes: bytesOf(buffers) });
    } catch (error) {
      waiting.reject(error as Error);
    }
  };
}
