/** The worker of a `SurfaceStream`: it receives and decodes, so that the page's thread only moves messages. */

import type { Asked } from "./channel";
import { serveHost } from "./serve-host";

const scope = self as unknown as {
  postMessage(message: unknown, transfer: Transferable[]): void;
  onmessage: ((event: MessageEvent<Asked>) => void) | null;
};

const answer = serveHost((message, transfer) => scope.postMessage(message, transfer));
scope.onmessage = ({ data }) => void answer(data);
