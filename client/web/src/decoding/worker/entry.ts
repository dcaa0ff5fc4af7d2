/** A worker that decodes: in a browser, and in Node, whose workers have a port of their own. */
import { serveDecoder } from "./host";
import type { Port } from "./messages";

interface NodePort {
  postMessage(message: unknown, transfer: readonly unknown[]): void;
  on(type: "message", listener: (data: unknown) => void): void;
}

async function portOfNode(): Promise<Port> {
  const { parentPort } = (await import("node:worker_threads")) as unknown as { parentPort: NodePort };
  return {
    postMessage: (message, transfer) => parentPort.postMessage(message, transfer),
    addEventListener: (_, listener) => parentPort.on("message", (data) => listener({ data })),
    removeEventListener: () => undefined, // it listens as long as there is the worker
  };
}

serveDecoder("importScripts" in globalThis ? (globalThis as unknown as Port) : await portOfNode());
