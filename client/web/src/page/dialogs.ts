/** Questions to the user, each in a dialog of its own. */

import { html } from "../view/dom";

/** Shows a dialog until it is answered. @returns what its buttons are called by, or "" if it was left. */
export function ask(dialog: HTMLDialogElement): Promise<string> {
  document.body.append(dialog);
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue);
    });
    dialog.showModal();
  });
}

function buttons(answer: string, kind: string): HTMLElement {
  // Not one that submits: Enter in a field presses the first of those.
  const cancel = html("button", { type: "button" }, "Cancel");
  cancel.addEventListener("click", () => cancel.closest("dialog")?.close(""));
  return html("div", { class: "actions" }, cancel, html("button", { value: "yes", class: kind }, answer));
}

/** What is wrong with a token, by the server's words. */
const HEADINGS: Readonly<Record<string, string>> = {
  "bad-token": "The server does not know this token",
  "small-scope": "This token does not allow that",
};

/**
 * Asks for a token.
 *
 * @param code - Why, in the server's word: `no-token`, `bad-token` or `small-scope`.
 * @param problem - What the server says of the token that was given before.
 * @returns null if none was given.
 */
export async function askToken(code: string, problem: string): Promise<string | null> {
  const heading = HEADINGS[code];
  const input = html("input", {
    type: "password",
    id: "token",
    autocomplete: "off",
    spellcheck: "false",
    required: true,
  });
  const dialog = html(
    "dialog",
    { "aria-labelledby": "token-title" },
    html(
      "form",
      { method: "dialog" },
      html("h2", { id: "token-title" }, heading ?? "A token is needed"),
      html(
        "p",
        {},
        heading === undefined ? "This server gives its surfaces to those who have a token." : `${problem}.`,
      ),
      html("label", { for: "token" }, "Token (kept until this page is closed)"),
      input,
      buttons("Continue", "primary"),
    ),
  );
  const answer = await ask(dialog);
  return answer === "yes" && input.value.trim() !== "" ? input.value.trim() : null;
}

/** Asks whether a surface is to be deleted. */
export async function askDelete(name: string): Promise<boolean> {
  const dialog = html(
    "dialog",
    { "aria-labelledby": "delete-title" },
    html(
      "form",
      { method: "dialog" },
      html("h2", { id: "delete-title" }, "Delete this surface?"),
      html("p", {}, `${name} and its container are removed from the server. This cannot be undone.`),
      buttons("Delete", "danger"),
    ),
  );
  return (await ask(dialog)) === "yes";
}
