/** Questions of the page to a receiver, answered one after the other. */

import type { Receiver } from "./receiver";
import type { FromSource, Question } from "./source-messages";

/** What answers: a `Receiver`. */
export type Answering = Pick<Receiver, "grids" | "valuesAt">;

/** Answers come in the order of their questions, although hashing leaves the thread to others. */
export class Answers {
  private last: Promise<void> = Promise.resolve();

  /** @param post - Sends an answer; what it is to transfer comes beside it. */
  constructor(
    private readonly receiver: Answering,
    private readonly post: (answer: FromSource, transfer: Transferable[]) => void,
  ) {}

  /** Takes a question; its answer, or why there is none, is sent when those before it have been. */
  take(id: number, question: Question): void {
    this.last = this.last.then(() => this.answer(id, question));
  }

  private async answer(id: number, question: Question): Promise<void> {
    try {
      if (question.kind === "values") {
        const { moment, block, row, column } = question;
        this.post({ kind: "values", id, values: await this.receiver.valuesAt(moment, block, row, column) }, []);
        return;
      }
      const picture = await this.receiver.grids(question.moment, question.level, question.window);
      const buffers = picture.grids.flatMap(({ points, mask, rowsAt, columnsAt, attributes }) =>
        [points, mask, rowsAt, columnsAt, ...attributes.map(({ values }) => values)].flatMap((array) =>
          array === null ? [] : [array.buffer as ArrayBuffer],
        ),
      );
      this.post({ kind: "grids", id, picture }, [...new Set(buffers)]);
    } catch (error) {
      this.post({ kind: "refused", id, detail: error instanceof Error ? error.message : String(error) }, []);
    }
  }
}
