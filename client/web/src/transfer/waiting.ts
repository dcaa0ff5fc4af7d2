/** Waiting that others can end. */

/** Seconds of a clock that does not go back. */
export const seconds = (): number => performance.now() / 1000;

/** Those who wait, and who look again at what they wait for when something has changed. */
export class Waiting {
  private readonly wakers = new Set<() => void>();

  /** Let everybody look again. */
  wake(): void {
    for (const waker of [...this.wakers]) waker();
  }

  /**
   * Wait for the first of some promises; undefined: `wake` was called, or so many seconds are over.
   *
   * @param time Seconds; left out: any time.
   */
  first<T>(promises: readonly Promise<T>[], time?: number): Promise<T | undefined> {
    return new Promise((resolve, reject) => {
      let timer: ReturnType<typeof setTimeout> | undefined;
      const end = (): void => {
        clearTimeout(timer);
        this.wakers.delete(woken);
      };
      const woken = (): void => {
        end();
        resolve(undefined);
      };
      this.wakers.add(woken);
      if (time !== undefined) timer = setTimeout(woken, 1000 * time);
      for (const promise of promises) {
        promise.then(
          (value) => {
            end();
            resolve(value);
          },
          (error: unknown) => {
            end();
            reject(error);
          },
        );
      }
    });
  }

  /** Wait until `wake` is called, or so many seconds are over. */
  async woken(time?: number): Promise<void> {
    await this.first([], time);
  }
}
