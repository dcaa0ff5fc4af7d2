/** The worker's end: a decoder that does what is posted to it. */
import { plainError } from "../../errors";
import type { Surface } from "../../types";
import { Decoder } from "../decoder";
import { type Answer, buffersOf, type Call, type Port, type Request } from "./messages";

/** Decode for the other end of a port; one decoder at a time, which `open` replaces. */
export function serveDecoder(port: Port): void {
  let decoder: Decoder | null = null;
  let told = 0; // views that the other end knows of
  let last = Promise.resolve(); // a call waits for the one before it
  port.addEventListener("message", ({ data }) => {
    last = last.then(() => carry(data as Request));
  });

  async function carry({ id, call }: Request): Promise<void> {
    let surface: Surface | null = null;
    let error: Answer["error"] = null;
    try {
      if (call.do === "open") {
        decoder = new Decoder(call.module, call.options);
        told = 0;
      } else if (decoder === null) {
        throw new Error("expected a decoder to be opened first");
      } else {
        surface = await carryOut(decoder, call);
      }
    } catch (caught) {
      error = plainError(caught);
    }
    const views = (decoder?.layers.slice(told) ?? []).map((view) => view.info);
    told += views.length;
    const answer: Answer = { id, views, metadata: decoder?.metadata ?? null, surface, error };
    port.postMessage(answer, surface ? buffersOf(surface) : []);
  }
}

async function carryOut(decoder: Decoder, call: Exclude<Call, { do: "open" }>): Promise<Surface | null> {
  switch (call.do) {
    case "feed":
      decoder.feed(call.data);
      return null;
    case "feedAt":
      decoder.feedAt(call.offset, call.data);
      return null;
    case "focus":
      decoder.focus(call.region);
      return null;
    case "finish":
      decoder.finish();
      return null;
    case "surface":
      return viewOf(decoder, call.view).surfaceAsync(call.level ?? undefined);
    case "window":
      return viewOf(decoder, call.view).window(call.region, call.level ?? undefined);
  }
}

function viewOf(decoder: Decoder, number: number) {
  const view = decoder.layers[number];
  if (!view) throw new RangeError(`expected a view of 0 to ${decoder.layers.length - 1}, got ${number}`);
  return view;
}
