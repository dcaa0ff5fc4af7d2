/** Whether a notebook is light or dark: each program says so in its own way. */

/** What the page says; null: nothing, so what the browser is set to holds. */
export function themeOf(document: Document): "light" | "dark" | null {
  const { body, documentElement: root } = document;
  // JupyterLab and Notebook 7
  const jupyter = body.dataset.jpThemeLight;
  if (jupyter !== undefined) return jupyter === "true" ? "light" : "dark";
  // VS Code
  const { classList } = body;
  if (classList.contains("vscode-dark") || classList.contains("vscode-high-contrast")) {
    return classList.contains("vscode-high-contrast-light") ? "light" : "dark";
  }
  if (classList.contains("vscode-light")) return "light";
  // marimo, Colab
  for (const element of [root, body]) {
    if (element.classList.contains("dark") || element.getAttribute("theme") === "dark") return "dark";
    if (element.classList.contains("light") || element.getAttribute("theme") === "light") return "light";
  }
  return null;
}

/** Calls `changed` whenever the page may have become light or dark. @returns what ends it. */
export function watchTheme(document: Document, changed: () => void): () => void {
  const watcher = new MutationObserver(changed);
  const options = { attributes: true, attributeFilter: ["class", "theme", "data-jp-theme-light"] };
  watcher.observe(document.body, options);
  watcher.observe(document.documentElement, options);
  return () => watcher.disconnect();
}
