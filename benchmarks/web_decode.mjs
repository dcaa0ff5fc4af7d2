/** Decodes a container in a worker of Node once for each line of standard input; prints what that took as JSON. */
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";
import { isMainThread, parentPort, Worker, workerData } from "node:worker_threads";

const [library, container] = isMainThread ? process.argv.slice(2) : workerData;

/** Seconds of processor time within each kernel: every export is timed. */
const spent = {};

function used() {
  const { user, system } = process.cpuUsage();
  return (user + system) / 1e6;
}

function timed() {
  const Instance = WebAssembly.Instance;
  WebAssembly.Instance = function (module, imports) {
    const { exports } = new Instance(module, imports);
    const own = {};
    for (const [name, value] of Object.entries(exports)) {
      own[name] =
        typeof value !== "function"
          ? value
          : (...given) => {
              const before = used();
              const result = value(...given);
              spent[name] = (spent[name] ?? 0) + used() - before;
              return result;
            };
    }
    return { exports: own };
  };
}

async function work() {
  const { decode, loadKernels } = await import(pathToFileURL(library).href);
  const data = new Uint8Array(readFileSync(container));
  const usual = WebAssembly.Instance;
  parentPort.on("message", async (inside) => {
    for (const name of Object.keys(spent)) delete spent[name];
    WebAssembly.Instance = usual;
    if (inside) timed();
    const before = used();
    const { points } = (await decode(await loadKernels(), data)).blocks[0];
    parentPort.postMessage({ seconds: used() - before, points: points.values.length, kernels: { ...spent } });
  });
}

if (isMainThread) {
  const worker = new Worker(new URL(import.meta.url), { workerData: [library, container] });
  worker.on("message", (told) => console.log(JSON.stringify(told)));
  const lines = createInterface({ input: process.stdin });
  lines.on("line", (line) => worker.postMessage(line === "kernels"));
  lines.on("close", () => worker.terminate());
} else {
  await work();
}
