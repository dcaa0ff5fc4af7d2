import { defineConfig } from "vitest/config";

// Milliseconds after which something hangs, however busy the machine is, as `tests/patience.py` has it.
const PATIENCE = 600_000;

export default defineConfig({
  test: {
    include: ["tests/**/*.test.ts"],
    testTimeout: PATIENCE,
    hookTimeout: PATIENCE,
    expect: { poll: { timeout: PATIENCE } },
    maxWorkers: 2,
  },
});
