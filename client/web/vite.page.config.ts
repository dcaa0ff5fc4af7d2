import { resolve } from "node:path";
import { defineConfig } from "vite";

const own = (path: string): string => resolve(import.meta.dirname ?? ".", path);

/**
 * The page that servers and `lodestream open` show: everything bundled, addresses relative to the page itself. The
 * element is a module of its own, `assets/view-*.js`, which imports nothing: widgets in notebooks load it too.
 */
export default defineConfig({
  root: own("src/page"),
  base: "./",
  logLevel: "warn",
  build: {
    target: "es2022",
    outDir: own("dist/page"),
    emptyOutDir: true,
    assetsInlineLimit: 0,
    chunkSizeWarningLimit: 1000,
    modulePreload: { polyfill: false },
    rolldownOptions: {
      input: { index: own("src/page/index.html"), view: own("src/view/index.ts") },
      preserveEntrySignatures: "allow-extension",
      output: { entryFileNames: "assets/[name]-[hash].js" },
    },
  },
  worker: { format: "es" },
});
