/** The worker of `LodeSource`: stream, decoder and conversion to grids share one thread that is not the page's. */

import { Answers } from "./answers";
import { AskedParts } from "./asked-parts";
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
const answers = new Answers(receiver, (answer, transfer) => scope.postMessage(answer, transfer));
const parts = new AskedParts((message) => scope.postMessage(message));

scope.onmessage = ({ data }) => {
  switch (data.kind) {
    case "open":
      void receiver.open(data.url ?? parts.read, data.token);
      break;
    case "part":
    case "no part":
      parts.take(data);
      break;
    case "question":
      answers.take(data.id, data.question);
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
