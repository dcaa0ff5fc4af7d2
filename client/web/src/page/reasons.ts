/** Why a surface is not there: two lines, and the rest on request. */

import { html, setText } from "../view/dom";

let last = 0;

/**
 * A reason in two lines, with a button that shows the rest if it takes more.
 *
 * @param role - Of its words: `alert` if they are to be read out at once.
 */
export function reasonElement(text: string, role: string | null = null): HTMLElement {
  const id = `reason-${++last}`;
  const words = html("span", { class: "words", id, ...(role === null ? {} : { role }) }, text);
  const more = html(
    "button",
    { type: "button", class: "plain more", hidden: true, "aria-expanded": "false", "aria-controls": id },
    "More",
  );
  const element = html("div", { class: "reason" }, words, more);
  more.addEventListener("click", () => {
    const open = element.classList.toggle("open");
    more.setAttribute("aria-expanded", String(open));
    setText(more, open ? "Less" : "More");
  });
  // How many lines a text takes is known once it is seen, and changes with the window.
  new ResizeObserver(() => {
    if (!element.classList.contains("open")) more.hidden = words.scrollHeight <= words.clientHeight + 1;
  }).observe(words);
  return element;
}
