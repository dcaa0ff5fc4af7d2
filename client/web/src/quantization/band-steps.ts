/** Steps of quantised coordinates: a coefficient is its index times its band's step (docs/format.md, section 8.1). */

import type { TileTable } from "../entropy/tile-table";
import type { Band, Layout } from "../grid/layout";

const NODES = [65536, 53303, 39201, 27993, 19842, 14039];
const DETAILS = [65536, 77936, 69201, 52586, 37885, 26915];

/** The step of each band of a table, in lattice steps: at least 1, below 2^26. */
export function bandSteps(table: TileTable, base: number): number[] {
  const known = new Map<string, number>(); // many tiles have bands of the same kind
  return table.layout.tiles.flatMap((tile, number) =>
    table.members[number]!.map((band) => {
      const key = `${tile.level} ${band.grid} ${band.kind}`;
      const step = known.get(key) ?? stepOf(band, tile.level, table.layout, base);
      known.set(key, step);
      return step;
    }),
  );
}

function stepOf(band: Band, level: number, layout: Layout, base: number): number {
  const product = BigInt(base) * BigInt(along(band, level, layout, 0)) * BigInt(along(band, level, layout, 1));
  return Math.max(1, Number(product >> 32n));
}

/** 2^16 over the norm of the synthesis function along an axis, by the steps from there to the finest level. */
function along(band: Band, level: number, layout: Layout, axis: 0 | 1): number {
  const first = Math.max(level, 1);
  let count = 0;
  let details: boolean = band.kind[axis];
  if (layout.grids[band.grid]!.interface && axis === 1) {
    // The points of an interface reach across the patches beside it, as nodes do.
    count = layout.levels + 1 - first;
    details = false;
  } else {
    for (let k = first; k <= layout.levels; k++) count += Number(layout.steps(band.grid, k)[axis].midpoints > 0);
  }
  const halvings = Math.max(0, Math.floor((count - 4) / 2));
  return (details ? DETAILS : NODES)[count - 2 * halvings]! >> halvings;
}
