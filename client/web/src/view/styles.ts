/** The element's style sheet, adopted by its shadow root: a Content-Security-Policy without inline styles allows that. */

const DARK = `
  --paper: #12181b; --sheet: #182024; --ink: #e4eaec; --soft: #9babb2; --line: #2c373c; --field: #222c31;
  --accent: #58bcd6; --accent-ink: #06222b; --warn: #f0a860; --second: #e08ab8; --sky: linear-gradient(#1b2428, #0f1416 75%);
`;

const CSS = `
:host {
  display: block; position: relative; container-type: size; min-height: 20rem; contain: layout paint;
  --paper: #fbfcfc; --sheet: #ffffff; --ink: #1a2226; --soft: #56646b; --line: #d9e0e3; --field: #eef2f3;
  --accent: #0b6b86; --accent-ink: #ffffff; --warn: #9a4a00; --second: #a8497a; --sky: linear-gradient(#e9eff2, #f9fbfb 70%);
  color: var(--ink); background: var(--paper); font: 13px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif;
  font-variant-numeric: tabular-nums;
}
@media (prefers-color-scheme: dark) { :host(:not([theme="light"])) { ${DARK} } }
:host([theme="light"]) { color-scheme: light }
:host([theme="dark"]) { color-scheme: dark; ${DARK} }
:host([hidden]) { display: none }
* { box-sizing: border-box }
[hidden] { display: none !important }
.frame { display: grid; grid-template: minmax(0, 1fr) auto / minmax(0, 1fr) 20rem; height: 100% }
.stage { position: relative; min-width: 0; min-height: 0; background: var(--sky); overflow: hidden }
canvas { position: absolute; inset: 0; width: 100%; height: 100%; display: block; touch-action: none; cursor: grab }
canvas:active { cursor: grabbing }
canvas:focus-visible { outline: 2px solid var(--accent); outline-offset: -3px }
.mark { position: absolute; left: -5px; top: -5px; width: 10px; height: 10px; border-radius: 50%; border: 2px solid #fff; box-shadow: 0 0 0 1.5px #0009; pointer-events: none }
.scales { position: absolute; left: 14px; bottom: 12px; display: flex; align-items: flex-end; gap: 12px; pointer-events: none;
  padding: 6px 10px; border-radius: 6px; background: color-mix(in srgb, var(--sheet) 72%, transparent) }
.scales:not(:has(> :not([hidden]))) { display: none }
.compass { width: 36px; height: 36px } .scale { width: 130px; height: 24px; overflow: visible }
.compass-ring { fill: none; stroke: var(--soft); stroke-opacity: .45 } .north { fill: var(--ink) }
.scale-line { fill: none; stroke: var(--ink); stroke-width: 1.5 } .scale-text { fill: var(--ink); font-size: 11px }
.legend { position: absolute; right: 14px; bottom: 12px; width: 12rem; padding: 7px 10px 6px; border-radius: 6px;
  background: color-mix(in srgb, var(--sheet) 86%, transparent); pointer-events: none }
.legend-title { font-size: 12px; margin-bottom: 4px } .legend-bar { display: block; width: 100%; height: 9px; border-radius: 2px }
.legend-ticks { display: flex; justify-content: space-between; font-size: 11px; margin-top: 2px; color: var(--soft) }
.legend-note { font-size: 11px; color: var(--soft) } .legend-note:empty { display: none }
.notice { position: absolute; left: 50%; top: 14px; transform: translateX(-50%); max-width: calc(100% - 28px); padding: 6px 14px;
  border-radius: 6px; background: var(--sheet); border: 1px solid var(--line); color: var(--warn); box-shadow: 0 2px 10px #0001 }
.notice:empty { display: none }
.values { grid-column: 1; border-top: 1px solid var(--line); background: var(--sheet); padding: 7px 14px; min-height: 4.2em; margin: 0; align-content: start;
  display: flex; flex-wrap: wrap; gap: 2px 18px }
.values b { font-weight: 600 } .values .dim { color: var(--soft) }
.panel { grid-row: 1 / 3; grid-column: 2; overflow-y: auto; border-left: 1px solid var(--line); background: var(--sheet); padding: 4px 16px 16px }
.panel:focus-visible { outline: 2px solid var(--accent); outline-offset: -2px }
section { padding: 12px 0 14px; border-bottom: 1px solid var(--line) } section:last-child { border-bottom: 0 }
h2 { font-size: 11px; font-weight: 600; letter-spacing: .06em; text-transform: uppercase; color: var(--soft); margin: 0 0 8px }
.status { margin: 0 0 2px; font-weight: 600 } .detail { margin: 0 0 8px; color: var(--soft) } .detail:empty { display: none }
.bar { height: 4px; border-radius: 2px; background: var(--field); overflow: hidden; margin: 6px 0 10px } .bar i { display: block; height: 100%; width: 0; background: var(--accent) }
.figures { display: grid; grid-template-columns: 1fr 1fr; gap: 0 14px; margin: 0 0 8px } .figures dt { color: var(--soft); font-size: 12px } .figures dd { margin: 0; font-size: 15px }
.figures dt::before { content: ""; display: inline-block; width: 9px; height: 3px; border-radius: 2px; margin-right: 6px; vertical-align: middle; background: var(--accent) }
.figures dt.max::before { background: var(--second) }
.curve { display: block; width: 100%; max-width: 24rem; margin: 2px 0 4px; overflow: visible } .curve .grid { stroke: var(--line); stroke-width: 1 }
.curve .tick { fill: var(--soft); font-size: 9.5px } .curve .line { fill: none; stroke-width: 1.3; stroke-opacity: .55 }
.curve .rms { stroke: var(--accent) } .curve .max { stroke: var(--second) } .curve .dot.rms { fill: var(--accent); stroke: none } .curve .dot.max { fill: var(--second); stroke: none }
.curve .marker { stroke: var(--ink); stroke-opacity: .6; stroke-dasharray: 3 3 }
.row { display: flex; align-items: center; gap: 8px; margin: 7px 0; flex-wrap: wrap } .row > label:first-child, .row > .name { flex: 0 0 5.6rem; color: var(--soft) }
.row .grow { flex: 1 1 3.4rem; min-width: 0 } .row .small { padding: 4px 8px } .row.end { justify-content: flex-end; margin: 0 } .row.end select { background: none; color: var(--soft); padding: 0 2px; font-size: 12px; min-height: 24px } .row.check label { display: flex; gap: 8px; align-items: center; flex: 1 1 auto; color: var(--ink) }
select, input[type=number], button { font: inherit; color: inherit; background: var(--field); border: 1px solid transparent; border-radius: 5px; padding: 4px 8px; min-height: 28px; min-width: 0 }
input[type=number] { width: 100%; appearance: textfield } input::-webkit-inner-spin-button { display: none } input[type=range] { accent-color: var(--accent); min-width: 0; margin: 0 } input[type=checkbox] { accent-color: var(--accent); margin: 0; width: 15px; height: 15px }
button { cursor: pointer; padding: 4px 12px } button:hover { border-color: var(--soft) }
button.primary { background: var(--accent); color: var(--accent-ink); font-weight: 600 } button.quiet { background: none; border-color: var(--line) }
:is(select, input, button, summary):focus-visible { outline: 2px solid var(--accent); outline-offset: 1px }
output { min-width: 3.2em; text-align: right } summary { cursor: pointer; color: var(--soft) }
dl.keys { display: grid; grid-template-columns: auto 1fr; gap: 3px 12px; margin: 8px 0 0 } .keys dt { font-weight: 600 } .keys dd { margin: 0; color: var(--soft) }
.hidden-text { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); white-space: nowrap }
@container (max-width: 46rem) {
  .frame { grid-template: minmax(15rem, 58%) auto minmax(0, 1fr) / minmax(0, 1fr) }
  .panel { grid-row: 3; grid-column: 1; border-left: 0; border-top: 1px solid var(--line) }
  .legend { width: 9rem; right: 8px; bottom: 8px } .scales { left: 8px; bottom: 8px }
  .compass { width: 30px; height: 30px }
}
`;

let sheet: CSSStyleSheet | null = null;

/** The style sheet, one for all elements. */
export function styles(): CSSStyleSheet {
  if (sheet === null) {
    sheet = new CSSStyleSheet();
    sheet.replaceSync(CSS);
  }
  return sheet;
}
