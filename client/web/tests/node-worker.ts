/** The worker of a stream for Node: what `src/transfer/worker.ts` is in a page. */
import { parentPort, workerData } from "node:worker_threads";
import { type SocketClass, serveHost } from "../src";

const { default: WebSocket } = (await import(/* @vite-ignore */ workerData.ws)) as { default: unknown };
const answer = serveHost((message, transfer) => parentPort!.postMessage(message, transfer as never), {
  WebSocket: WebSocket as SocketClass,
});
parentPort!.on("message", answer);
