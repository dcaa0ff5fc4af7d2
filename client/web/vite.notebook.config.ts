import { resolve } from "node:path";
import { defineConfig } from "vite";

/** The module of widgets in notebooks, beside the page, whose `assets/view-*.js` it asks the kernel for. */
export default defineConfig({
  publicDir: false,
  logLevel: "warn",
  build: {
    target: "es2022",
    outDir: resolve(import.meta.dirname ?? ".", "dist/page"),
    emptyOutDir: false,
    lib: {
      entry: { notebook: resolve(import.meta.dirname ?? ".", "src/notebook/widget.ts") },
      formats: ["es"],
    },
  },
});
