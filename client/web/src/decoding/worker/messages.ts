/**
 * What is posted between a `RemoteDecoder` and the worker that decodes for it.
 *
 * Requests have a number, which their answer repeats; answers come in the order of the requests. Bytes and the
 * arrays of surfaces are transferred, not copied.
 */
import type { Metadata } from "../../container/sections";
import type { PlainError } from "../../errors";
import type { PointArray, Region, Surface, ViewInfo } from "../../types";
import type { DecoderOptions } from "../decoder";

/** What a decoder is asked to do. Views are named by their number among all so far, from 0 on. */
export type Call =
  | { readonly do: "open"; readonly options: DecoderOptions; readonly module: WebAssembly.Module }
  | { readonly do: "feed"; readonly data: Uint8Array }
  | { readonly do: "feedAt"; readonly offset: number; readonly data: Uint8Array }
  | { readonly do: "focus"; readonly region: Region | null }
  | { readonly do: "finish" }
  | { readonly do: "surface"; readonly view: number; readonly level: number | null }
  | { readonly do: "window"; readonly view: number; readonly region: Region; readonly level: number | null };

/** A call with its number. */
export interface Request {
  readonly id: number;
  readonly call: Call;
}

/** What has come of a call: views that are new since the last answer, also where it failed; a surface, where asked. */
export interface Answer {
  readonly id: number;
  readonly views: readonly ViewInfo[];
  readonly metadata: Metadata | null;
  readonly surface: Surface | null;
  readonly error: PlainError | null;
}

/** What takes messages. */
export type Listener = (event: { data: unknown }) => void;

/** One end of a channel: a worker, a port, or a worker's own scope. */
export interface Port {
  postMessage(message: unknown, transfer: Transferable[]): void;
  addEventListener(type: "message", listener: Listener): void;
  removeEventListener(type: "message", listener: Listener): void;
}

/** The memory of a surface's arrays, to be transferred with it. */
export function buffersOf(surface: Surface): ArrayBuffer[] {
  const found = new Set<ArrayBufferLike>();
  for (const { points, mask, attributes, rows, columns } of surface.blocks) {
    const arrays: PointArray[] = [points, ...attributes.values()];
    for (const { values } of arrays) found.add(values.buffer);
    for (const array of [mask, rows, columns]) if (array) found.add(array.buffer);
  }
  return [...found] as ArrayBuffer[];
}
