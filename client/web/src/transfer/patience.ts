/** How long a request may wait for the other side. */

import { LodestreamError, SilenceError, TruncatedStreamError, UnreachableError } from "../errors";

/** Ends a request after a silence. */
export class Patience {
  private readonly controller = new AbortController();
  private readonly abort = (): void => this.controller.abort();
  private silent = false;

  constructor(
    private readonly seconds: () => number,
    private readonly outer: AbortSignal,
  ) {
    if (outer.aborted) this.abort();
    outer.addEventListener("abort", this.abort);
  }

  get signal(): AbortSignal {
    return this.controller.signal;
  }

  /** The request has ended. */
  end(): void {
    this.outer.removeEventListener("abort", this.abort);
  }

  async wait<T>(url: string, step: () => Promise<T>): Promise<T> {
    const seconds = this.seconds();
    const timer = setTimeout(() => {
      this.silent = true;
      this.abort();
    }, 1000 * seconds);
    try {
      return await step();
    } catch (error) {
      this.end();
      if (error instanceof LodestreamError) throw error;
      if (this.silent) {
        throw new SilenceError(`expected more of the stream, but ${url} has sent nothing for ${seconds} seconds`);
      }
      if (this.outer.aborted) throw new TruncatedStreamError(`an answer of ${url} was left`);
      throw new UnreachableError(`no connection to ${url}, or it broke: ${(error as Error).message}`);
    } finally {
      clearTimeout(timer);
    }
  }
}
