/**
 * How fast the library decodes, beside the Python library: seconds of processor time and of the clock, of the same
 * containers, on this machine. `npm run bench` builds the library before; PYTHON names a Python with Lodestream.
 *
 * Ends with 1 where this library takes more than twice the processor time of the other.
 */
import { execFileSync } from "node:child_process";
import { existsSync, mkdtempSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { Decoder, loadKernels } from "../dist/index.js";

const ROOT = resolve(import.meta.dirname, "../../..");
const PYTHON = process.env.PYTHON ?? [join(ROOT, ".venv/bin/python")].find((path) => existsSync(path)) ?? "python3";
const REPEATS = 5;
const MOST = 2;

/** Least seconds of processor and clock of some repetitions; the first ones are compiled on the way. */
async function least(work) {
  let [processor, clock] = [Infinity, Infinity];
  for (let i = 0; i < REPEATS; i++) {
    const [started, used] = [performance.now(), process.cpuUsage()];
    await work();
    const { user, system } = process.cpuUsage(used);
    processor = Math.min(processor, (user + system) / 1e6);
    clock = Math.min(clock, (performance.now() - started) / 1e3);
  }
  return { processor, clock };
}

async function decode(kernels, data) {
  const decoder = new Decoder(kernels);
  decoder.feed(data);
  decoder.finish();
  await decoder.view().surfaceAsync();
}

const folder = mkdtempSync(join(tmpdir(), "lodestream-bench-"));
try {
  const environment = { ...process.env, PYTHONPATH: [ROOT, join(ROOT, "core")].join(":") };
  const options = { cwd: ROOT, env: environment, encoding: "utf8" };
  const said = execFileSync(PYTHON, ["-m", "tests.web.bench", folder, String(REPEATS)], options);
  const python = JSON.parse(said);
  const kernels = await loadKernels();
  let worst = 0;
  console.log("surface           points   bytes   Python, s (clock)   here, s (clock)   ratio");
  for (const name of readdirSync(folder).sort()) {
    const data = new Uint8Array(readFileSync(join(folder, name)));
    const here = await least(() => decode(kernels, data));
    const { points, processor, clock } = python[name];
    const ratio = here.processor / processor;
    worst = Math.max(worst, ratio);
    const seconds = (value) => value.toFixed(3).padStart(7);
    console.log(
      `${name.padEnd(14)} ${String(points).padStart(9)} ${String(data.length).padStart(8)}` +
        `  ${seconds(processor)} (${seconds(clock)})` +
        `  ${seconds(here.processor)} (${seconds(here.clock)})   ${ratio.toFixed(2)}`,
    );
  }
  if (worst > MOST) {
    console.error(`expected at most ${MOST} times Python's processor time, got ${worst.toFixed(2)}`);
    process.exitCode = 1;
  }
} finally {
  rmSync(folder, { recursive: true });
}
