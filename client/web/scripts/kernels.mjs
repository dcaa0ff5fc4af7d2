/**
 * Compiles the kernels of decoding, core/kernels/*.c and kernels/*.c, into one WebAssembly module without imports, and
 * writes it as src/kernels/module.ts unless that was made from the same sources.
 *
 * The compiler is zig: `ZIG` names it, else it is the `ziglang` wheel of `PYTHON`, of the project's .venv or of python3,
 * else what was unpacked into build/ziglang.
 */
import { execFileSync, spawnSync } from "node:child_process";
import { createHash } from "node:crypto";
import { existsSync, mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { basename, join, relative, resolve } from "node:path";

const HERE = resolve(import.meta.dirname ?? new URL(".", import.meta.url).pathname, "..");
const ROOT = resolve(HERE, "../..");
const CORE = join(ROOT, "core/kernels");
const OWN = join(HERE, "kernels");
const TARGET = join(HERE, "src/kernels/module.ts");
const MOST_BYTES = 60_000;

/** Most of the time is spent in what no option makes faster; lifting is four times as fast when it is vectorised. */
const FAST = ["read_lift.c"];
/** What has to be inlined says so in the sources; more of it makes the module larger and not faster. */
const FAST_FLAGS = ["-O3", "-fno-unroll-loops", "-mllvm", "-inline-threshold=100"];

/** The same bits as everywhere: nothing is fused. Large stacks would only hide a mistake. */
const FLAGS = [
  ...["-mcpu=generic+simd128+bulk_memory+sign_ext+nontrapping_fptoint"],
  ...["-std=c11", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-strict-aliasing"],
  "-Wno-ignored-attributes",
];
const TARGET_FLAG = "--target=wasm32-freestanding";
const LINK = ["-nostdlib", "-Wl,--no-entry", "-Wl,--export=__heap_base", "-Wl,--strip-all", "-Wl,--gc-sections"];

/** The kernels as this folder wraps them, and what these need beside. */
function sources() {
  const own = readdirSync(OWN).filter((name) => name.endsWith(".c"));
  return [join(CORE, "class_coder.c"), ...own.sort().map((name) => join(OWN, name))];
}

/** The hash of all that the module is made from. */
function fingerprint() {
  const hash = createHash("sha256");
  const files = [CORE, OWN].flatMap((folder) =>
    readdirSync(folder)
      .filter((name) => /\.[ch]$/.test(name))
      .sort()
      .map((name) => join(folder, name)),
  );
  for (const path of files) hash.update(readFileSync(path));
  hash.update(readFileSync(new URL(import.meta.url)));
  return hash.digest("hex").slice(0, 16);
}

/** The command of zig's C compiler. */
function compiler() {
  if (process.env.ZIG) return [...process.env.ZIG.split(" "), "cc"];
  const pythons = [process.env.PYTHON, join(ROOT, ".venv/bin/python"), "python3", "python"];
  for (const python of pythons) {
    if (python && spawnSync(python, ["-m", "ziglang", "version"], { stdio: "ignore" }).status === 0) {
      return [python, "-m", "ziglang", "cc"];
    }
  }
  const unpacked = join(ROOT, "build/ziglang/ziglang/zig");
  if (existsSync(unpacked)) return [unpacked, "cc"];
  throw new Error(
    "expected zig, to compile the kernels: pip install 'ziglang>=0.15,<0.18' for a Python that PYTHON names, or set ZIG",
  );
}

function main() {
  const made = fingerprint();
  if (existsSync(TARGET) && readFileSync(TARGET, "utf8").includes(made)) return;
  const [command, ...first] = compiler();
  const folder = mkdtempSync(join(tmpdir(), "lodestream-kernels-"));
  try {
    const out = join(folder, "kernels.wasm");
    const run = (flags) =>
      execFileSync(command, [...first, TARGET_FLAG, ...flags], {
        env: { ZIG_GLOBAL_CACHE_DIR: folder, ZIG_LOCAL_CACHE_DIR: folder, ...process.env },
        stdio: ["ignore", "inherit", "inherit"],
      });
    const objects = sources().map((source) => {
      const object = join(folder, `${basename(source)}.o`);
      const level = FAST.includes(basename(source)) ? FAST_FLAGS : ["-Os"];
      run([...FLAGS, ...level, `-DLODE_SOURCES="${made}"`, `-I${CORE}`, "-c", source, "-o", object]);
      return object;
    });
    run([...LINK, ...objects, "-o", out]);
    const bytes = readFileSync(out);
    const module = new WebAssembly.Module(bytes);
    const imports = WebAssembly.Module.imports(module);
    if (imports.length) throw new Error(`expected a module without imports, got ${imports.map((i) => i.name)}`);
    if (bytes.length > MOST_BYTES) throw new Error(`expected at most ${MOST_BYTES} bytes, got ${bytes.length}`);
    // In hexadecimal, which compressed takes a fifth less than base 64, whose letters begin anywhere in a byte.
    const text = [
      `/** Made by scripts/kernels.mjs from sources with the hash ${made}; not to be edited. */`,
      `export const KERNELS_HEX: string =\n  "${bytes.toString("hex")}";`,
    ];
    writeFileSync(TARGET, `${text.join("\n")}\n`);
    console.log(`compiled ${relative(process.cwd(), TARGET)}: ${bytes.length} bytes`);
  } finally {
    rmSync(folder, { recursive: true, force: true });
  }
}

main();
