/** Decoded blocks of heights, at most so many bytes of them. */

/** Arrays by key; those that were used least recently leave first. */
export class BlockCache {
  private readonly kept = new Map<string, Float32Array>();
  private bytes = 0;

  /** @param maxBytes Of all arrays together. */
  constructor(private readonly maxBytes: number) {}

  get(key: string): Float32Array | undefined {
    const found = this.kept.get(key);
    if (found !== undefined) {
      this.kept.delete(key);
      this.kept.set(key, found);
    }
    return found;
  }

  set(key: string, block: Float32Array): void {
    if (this.kept.has(key)) return;
    this.kept.set(key, block);
    this.bytes += block.byteLength;
    for (const [oldest, { byteLength }] of this.kept) {
      if (this.bytes <= this.maxBytes) return;
      this.kept.delete(oldest);
      this.bytes -= byteLength;
    }
  }
}
