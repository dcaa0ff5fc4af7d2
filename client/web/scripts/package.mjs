/**
 * Makes the declarations in dist/types fit for every way in which TypeScript resolves modules, which wants the names of
 * files with their endings, and puts the licence beside package.json, where npm looks for it.
 */
import { copyFileSync, existsSync, readdirSync, readFileSync, writeFileSync } from "node:fs";
import { dirname, join, resolve } from "node:path";

const HERE = resolve(import.meta.dirname, "..");
const TYPES = join(HERE, "dist/types");

function withEnding(file, name) {
  const path = join(dirname(file), name);
  if (existsSync(`${path}.d.ts`)) return `${name}.js`;
  if (existsSync(join(path, "index.d.ts"))) return `${name}/index.js`;
  throw new Error(`expected declarations for ${name}, which ${file} imports`);
}

for (const name of readdirSync(TYPES, { recursive: true })) {
  if (!name.endsWith(".d.ts")) continue;
  const file = join(TYPES, name);
  const text = readFileSync(file, "utf8");
  const fitted = text.replace(
    /(\bfrom |\bimport\(|\bimport )"(\.{1,2}\/[^"]*?)(?:\.js)?"/g,
    (_, before, path) => `${before}"${withEnding(file, path)}"`,
  );
  if (fitted !== text) writeFileSync(file, fitted);
}
copyFileSync(resolve(HERE, "../../LICENSE"), join(HERE, "LICENSE"));
