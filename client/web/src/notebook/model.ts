/** The widget of the kernel as a page sees it: what anywidget gives to `render`. */

/** Values that both sides have, and messages between them. */
export interface Model {
  get(name: string): unknown;
  set(name: string, value: unknown): void;
  save_changes(): void;
  // biome-ignore lint/suspicious/noExplicitAny: what is called depends on the event
  on(event: string, callback: (...given: any[]) => void): void;
  // biome-ignore lint/suspicious/noExplicitAny: see above
  off(event: string, callback: (...given: any[]) => void): void;
  send(content: unknown): void;
}

/** What `render` is called with, once for each place where the widget is shown. */
export interface Shown {
  readonly model: Model;
  readonly el: HTMLElement;
}

/** Bytes as they come: views in Jupyter and marimo, plain memory elsewhere. */
export type Buffers = readonly (ArrayBuffer | ArrayBufferView)[];

/** The bytes of a message, without a copy. */
export function bytesOf(buffers: Buffers | undefined): Uint8Array {
  const first = buffers?.[0];
  if (first === undefined) throw new Error("expected bytes from the kernel, got a message without any");
  if (first instanceof ArrayBuffer) return new Uint8Array(first);
  return new Uint8Array(first.buffer, first.byteOffset, first.byteLength);
}
