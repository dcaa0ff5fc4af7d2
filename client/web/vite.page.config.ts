import { resolve } from "node:path";
import { defineConfig } from "vite";

/** The page that servers and `lodestream view` show: everything bundled, addresses relative to the page itself. */
export default defineConfig({
  root: resolve(import.meta.dirname ?? ".", "src/page"),
  base: "./",
  build: {
    target: "es2022",
    outDir: resolve(import.meta.dirname ?? ".", "dist/page"),
    emptyOutDir: true,
    assetsInlineLimit: 0,
  },
  worker: { format: "es" },
});
