/** The host in a worker: questions come and answers go as messages. */

import { plainError } from "../errors";
import type { Surface } from "../types";
import type { Asked, FromHost } from "./channel";
import { Host } from "./host";
import type { Platform, Questions } from "./questions";

/** Let a host answer what is posted to a worker. */
export function serveHost(post: (message: FromHost, transfer: Transferable[]) => void, platform: Platform = {}) {
  const host = new Host(
    (told) => post({ told }, told.kind === "bytes" ? [told.data.buffer as ArrayBuffer] : []),
    platform,
  );
  return async ({ id, name, given }: Asked): Promise<void> => {
    try {
      const answer = await answerOf(host, name, given);
      const made = name === "surface" || name === "window" ? buffersOf(answer as Surface) : [];
      post({ id, answer }, made);
    } catch (error) {
      post({ id, error: plainError(error) }, []);
    }
  };
}

/** What a host answers; what it throws comes as a broken promise. */
export async function answerOf(host: Host, name: keyof Questions, given: readonly unknown[]): Promise<unknown> {
  return (host[name] as (...given: readonly unknown[]) => unknown)(...given);
}

/** The memory of a surface's arrays that hold nothing else, and are made for whoever asks. */
function buffersOf(surface: Surface): ArrayBuffer[] {
  const found = new Set<ArrayBuffer>();
  for (const { points, attributes } of surface.blocks) {
    for (const { values } of [points, ...attributes.values()]) {
      const { buffer } = values;
      if (buffer instanceof ArrayBuffer && buffer.byteLength === values.byteLength) found.add(buffer);
    }
  }
  return [...found];
}
