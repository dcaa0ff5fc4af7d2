/** Bytes that arrive little by little and are taken from the front. */
export class ByteBuffer {
  #bytes = new Uint8Array(1024);
  #start = 0;
  #end = 0;

  /** Bytes that are there. */
  get length(): number {
    return this.#end - this.#start;
  }

  /** Add bytes at the end; they are copied. */
  append(data: Uint8Array): void {
    if (this.#end + data.length > this.#bytes.length) {
      const length = this.length + data.length;
      const room = length > this.#bytes.length / 2 ? new Uint8Array(2 * length) : this.#bytes;
      room.set(this.#bytes.subarray(this.#start, this.#end));
      this.#bytes = room;
      this.#end = this.length;
      this.#start = 0;
    }
    this.#bytes.set(data, this.#end);
    this.#end += data.length;
  }

  /** The first bytes, at most so many: a view that is valid until the next call. */
  peek(count: number): Uint8Array {
    return this.#bytes.subarray(this.#start, Math.min(this.#start + count, this.#end));
  }

  /** Take the first bytes out, as many as there are of these: a copy. */
  take(count: number): Uint8Array {
    const taken = this.peek(count).slice();
    this.drop(taken.length);
    return taken;
  }

  /** Forget the first bytes. */
  drop(count: number): void {
    this.#start = Math.min(this.#start + count, this.#end);
    if (this.#start === this.#end) {
      this.#start = 0;
      this.#end = 0;
      if (this.#bytes.length > 1 << 20) this.#bytes = new Uint8Array(1024);
    }
  }
}
