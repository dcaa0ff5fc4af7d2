/** The worker around `Geometry`: everything that is drawn is computed here. */

import { type Change, Geometry } from "./geometry";
import type { FromGeometry, PatchBuffers, ToGeometry } from "./geometry-messages";

const geometry = new Geometry();
let picture = -1;
let level = 0;

const scope = self as unknown as {
  postMessage(message: FromGeometry, transfer?: Transferable[]): void;
  onmessage: ((event: MessageEvent<ToGeometry>) => void) | null;
};

scope.onmessage = ({ data }) => {
  try {
    take(data);
  } catch (error) {
    scope.postMessage({ kind: "failed", detail: error instanceof Error ? error.message : String(error) });
  }
};

function take(message: ToGeometry): void {
  switch (message.kind) {
    case "picture": {
      const { grids, options } = message;
      picture = message.picture;
      level = message.level;
      send(geometry.setPicture(grids, options), true);
      wants();
      break;
    }
    case "eye": {
      const change = geometry.setEye(message.eye);
      if (picture < 0) break;
      if (change.patches.length > 0) send(change, false);
      wants();
      break;
    }
    case "field": {
      const change = geometry.setField(message.field);
      if (picture >= 0) send(change, false);
      break;
    }
    case "most":
      geometry.setMost(message.triangles);
      break;
    case "pick":
      scope.postMessage({ kind: "hit", id: message.id, hit: geometry.pick(message.origin, message.direction) });
      break;
  }
}

function wants(): void {
  if (!geometry.sees) return;
  const { region, finer } = geometry;
  scope.postMessage({ kind: "wants", level: Math.max(0, level + finer), region });
}

function send({ patches, triangles }: Change, fresh: boolean): void {
  const { frame, box } = geometry;
  const colouring = geometry.colouring();
  const message: FromGeometry = { kind: "patches", picture, level, fresh, patches, frame, box, colouring, triangles };
  scope.postMessage(message, patches.flatMap(buffersOf));
}

function buffersOf(patch: PatchBuffers): Transferable[] {
  const { positions, from, normals, fromNormals, values, fromValues, places, triangles, pieces } = patch;
  return [positions, from, normals, fromNormals, values, fromValues, places, triangles, pieces].flatMap((array) =>
    array === null ? [] : [array.buffer as ArrayBuffer],
  );
}
