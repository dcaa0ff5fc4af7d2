/** The worker of `lodeProtocol`: it receives, decodes and makes tiles, so that the page's thread only passes them on. */

import type { FromTiles, ToTiles } from "./messages";
import { serveTiles } from "./serve-tiles";

const scope = self as unknown as {
  postMessage(message: FromTiles, transfer: Transferable[]): void;
  onmessage: ((event: MessageEvent<ToTiles>) => void) | null;
};

const take = serveTiles((message, transfer) => scope.postMessage(message, transfer));
scope.onmessage = ({ data }) => take(data);
