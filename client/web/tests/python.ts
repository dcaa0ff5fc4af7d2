/** The Python library of this tree, which tests are compared with and whose servers they use. */
import { type ChildProcess, execFileSync, spawn } from "node:child_process";
import { existsSync } from "node:fs";
import { join, resolve } from "node:path";

const ROOT = resolve(import.meta.dirname ?? ".", "../../..");
const ENVIRONMENT = {
  ...process.env,
  PYTHONPATH: [ROOT, ...["core", "server", "client"].map((name) => join(ROOT, name))].join(":"),
};

/** `PYTHON`, that of the project's virtual environment, or the one on the path. */
export const PYTHON =
  process.env.PYTHON ?? [join(ROOT, ".venv/bin/python")].find((path) => existsSync(path)) ?? "python";

/** What a module prints. */
export function run(module: string, ...options: (string | number)[]): string {
  const given = ["-m", module, ...options.map(String)];
  return execFileSync(PYTHON, given, { cwd: ROOT, env: ENVIRONMENT, encoding: "utf8", maxBuffer: 2 ** 30 });
}

/** A module that goes on running; it ends when its standard input does. */
export function start(module: string, ...options: (string | number)[]): ChildProcess {
  const given = ["-m", module, ...options.map(String)];
  return spawn(PYTHON, given, { cwd: ROOT, env: ENVIRONMENT, stdio: ["pipe", "pipe", "inherit"] });
}
