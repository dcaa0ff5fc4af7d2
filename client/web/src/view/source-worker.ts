/** The worker of `LodeSource`: stream, decoder and conversion to grids share one thread that is not the page's. */

import { Receiver } from "./receiver";
import type { FromSource, ToSource } from "./source-messages";

const scope = self as unknown as {
  postMessage(message: FromSource, transfer?: Transferable[]): void;
  onmessage: ((event: MessageEvent<ToSource>) => void) | null;
};
const receiver = new Receiver({
  info: (info) => scope.postMessage({ kind: "info", info }),
  moment: (moment) => scope.postMessage({ kind: "moment", moment }),
  progress: (progress) => scope.postMessage({ kind: "progress", progress }),
  refined: () => scope.postMessage({ kind: "refined" }),
});

scope.onmessage = ({ data }) => {
  switch (data.kind) {
    case "open":
      void receiver.open(data.url, data.token);
      break;
    case "question":
      answer(data);
      break;
    case "focus":
      receiver.focus(data.region);
      break;
    case "target":
      receiver.setTarget(data.target);
      break;
    case "throttle":
      receiver.throttle(data.rate);
      break;
    case "stop":
      receiver.stop();
      break;
    case "resume":
      receiver.resume();
      break;
  }
};

function answer({ id, question }: Extract<ToSource, { kind: "question" }>): void {
  try {
    if (question.kind === "values") {
      const { moment, block, row, column } = question;
      scope.postMessage({ kind: "values", id, values: receiver.valuesAt(moment, block, row, column) });
      return;
    }
    const picture = receiver.grids(question.moment, question.level, question.window);
    const buffers = picture.grids.flatMap(({ points, mask, rowsAt, columnsAt, attributes }) =>
      [points, mask, rowsAt, columnsAt, ...attributes.map(({ values }) => values)].flatMap((array) =>
        array === null ? [] : [array.buffer as ArrayBuffer],
      ),
    );
    scope.postMessage({ kind: "grids", id, picture }, [...new Set(buffers)]);
  } catch (error) {
    scope.postMessage({ kind: "refused", id, detail: error instanceof Error ? error.message : String(error) });
  }
}
