import { resolve } from "node:path";
import { defineConfig } from "vite";

/** The npm package: the library, the custom element and the protocol for maps as ES modules; what the package depends on stays outside. */
export default defineConfig({
  build: {
    target: "es2022",
    outDir: "dist",
    emptyOutDir: true,
    sourcemap: true,
    lib: {
      entry: {
        index: resolve(import.meta.dirname ?? ".", "src/index.ts"),
        view: resolve(import.meta.dirname ?? ".", "src/view/index.ts"),
        maplibre: resolve(import.meta.dirname ?? ".", "src/maplibre/index.ts"),
      },
      formats: ["es"],
    },
    rolldownOptions: { external: [/^three(\/|$)/, "@msgpack/msgpack", /^node:/] },
  },
  worker: { format: "es" },
});
