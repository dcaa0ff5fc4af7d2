/** The view in the address of the page. */

import { parseView, type SharedView, withView } from "./url-state";

/** Browsers limit how often an address may be changed. Milliseconds. */
const PAUSE = 400;

/** Keeps a view in the part of the page's address after #. */
export class Sharing {
  private timer: ReturnType<typeof setTimeout> | undefined;

  /** @param read - The view now; null: none is to be kept. */
  constructor(private readonly read: () => SharedView | null) {}

  /** What the address says. */
  get given(): SharedView {
    return parseView(location.hash.replace(/^#/, ""));
  }

  /** Writes the view into the address, soon. */
  later(): void {
    this.timer ??= setTimeout(() => {
      this.timer = undefined;
      const view = this.read();
      if (view !== null) history.replaceState(history.state, "", withView(location.hash, view));
    }, PAUSE);
  }
}
