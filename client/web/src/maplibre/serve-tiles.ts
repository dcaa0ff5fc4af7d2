/** The worker's side of `WorkerTiles`: tiles are made here; projections that are not built in are asked of the page. */

import { errorFrom, plainError } from "../errors";
import type { FromTiles, ToTiles } from "./messages";
import type { ForeignTransform } from "./projection";
import { Tiles } from "./tiles";

/** What waits for a projection of the page. */
interface Waiting {
  resolve(places: Float64Array): void;
  reject(error: Error): void;
}

/** Answer what is posted to a worker. */
export function serveTiles(post: (message: FromTiles, transfer: Transferable[]) => void): (message: ToTiles) => void {
  const under = new Map<number, AbortController>();
  const waiting = new Map<number, Waiting>();
  let asked = 0;
  const foreign: ForeignTransform = (crs, places, back) =>
    new Promise((resolve, reject) => {
      asked += 1;
      waiting.set(asked, { resolve, reject });
      post({ kind: "transform", id: asked, crs, places, back }, [places.buffer as ArrayBuffer]);
    });
  let tiles: Tiles;

  const answer = async (message: ToTiles & { kind: "describe" | "tile" }): Promise<void> => {
    const { id, source, look } = message;
    const abort = new AbortController();
    under.set(id, abort);
    try {
      if (message.kind === "describe") {
        post({ kind: "described", id, answer: await tiles.describe(source, look) }, []);
      } else {
        const pixels = await tiles.tile(source, look, message.tile, abort.signal);
        post({ kind: "tile", id, answer: pixels }, [pixels.buffer]);
      }
    } catch (error) {
      post({ kind: "refused", id, error: plainError(error) }, []);
    }
    under.delete(id);
  };

  return (message) => {
    switch (message.kind) {
      case "begin":
        tiles = new Tiles(foreign, message.cacheBytes);
        break;
      case "leave":
        under.get(message.id)?.abort();
        break;
      case "transformed":
        waiting.get(message.id)?.resolve(message.places);
        waiting.delete(message.id);
        break;
      case "not transformed":
        waiting.get(message.id)?.reject(errorFrom(message.error));
        waiting.delete(message.id);
        break;
      default:
        void answer(message);
    }
  };
}
