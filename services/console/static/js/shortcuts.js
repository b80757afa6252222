// Keyboard shortcuts, in one table for the event handler and the help.

import { h, showDialog } from "./dom.js";

const TYPES = new Set(["text", "search", "password", ""]);

/** Whether the focused element accepts text. */
export function isTextField(target) {
  return target.tagName === "TEXTAREA" || target.tagName === "SELECT" || (target.tagName === "INPUT" && TYPES.has(target.type));
}

/** Table of keys: [group, [[keys, text, handler, {view, label}]]]. `view`: the only view in which the key is active. */
export function shortcutTable({ app, queue, view, decision, map }) {
  const review = { view: "review" };
  const onMap = { view: "map" };
  const arrow = (rows, columns) => (event) => {
    const far = event.shiftKey ? 5 : event.altKey ? 0.2 : 1;
    if (view.measurement.active) view.measurement.move(rows * far, columns * far);
    else if (document.activeElement?.id === "queue" && rows) queue.move(rows);
    else view.pan(0.1 * columns, 0.1 * rows);
  };
  return [
    ["Queue", [
      [["j"], "next contact", () => queue.move(1), review],
      [["k"], "previous contact", () => queue.move(-1), review],
      [["n"], "next unreviewed contact", () => app.nextUnreviewed(), review],
      [["o"], "next look at the same position", () => app.nextLook(), review],
      [["/"], "search", () => app.search(), review],
      [["l"], "only unreviewed contacts, or all", () => app.toggleReview(), review],
    ]],
    ["Decision", [
      [["1"], "mine-like", () => decision.choose("mine_like"), review],
      [["2"], "not mine-like", () => decision.choose("not_mine_like"), review],
      [["3"], "unsure", () => decision.choose("unsure"), review],
      [["Enter"], "send; set a measurement point", () => app.enter(), review],
      [["g"], "confidence", () => decision.confidence.focus(), review],
      [["w"], "write a remark (Ctrl+Enter sends)", () => decision.remark.focus(), review],
      [["u"], "undo the last decision", () => decision.undo(), review],
      [["r"], "request more data", () => app.request(), review],
    ]],
    ["Image", [
      [["m"], "measure: length, width, shadow", () => view.startMeasurement(), review],
      [["+", "="], "zoom in", () => view.zoom(1.5), review],
      [["-"], "zoom out", () => view.zoom(1 / 1.5), review],
      [["0"], "whole image", () => view.fit(), review],
      [["ArrowUp"], "", arrow(-1, 0), review], [["ArrowDown"], "", arrow(1, 0), review], [["ArrowLeft"], "", arrow(0, -1), review],
      [["ArrowRight"], "move image or point", arrow(0, 1), { view: "review", label: "arrows" }],
      [["["], "older version", () => view.stepVersion(-1), review],
      [["]"], "newer version", () => view.stepVersion(1), review],
      [["e"], "raw or enhanced layer", () => view.nextLayer(), review],
      [["s"], "side by side", () => view.nextCompare(), review],
      [["c"], "next colour map", () => view.nextMap(1), review],
      [[",", "."], "darker, brighter", (event) => view.changeGain(event.key === "." ? 1 : -1), review],
      [["a"], "automatic gain", () => view.changeGain(0), review],
      [["h"], "hatch missing areas", () => view.toggleHatch(), review],
    ]],
    ["Map", [
      [["j"], "next contact", () => map.move(1), onMap], [["k"], "previous contact", () => map.move(-1), onMap],
      [["Enter"], "review the selected contact", () => map.open(), onMap],
      [["+", "="], "zoom in", () => map.zoom(1.5), onMap], [["-"], "zoom out", () => map.zoom(1 / 1.5), onMap], [["0"], "fit all", () => map.fit(), onMap],
      [["ArrowUp"], "", () => map.pan(0, 80), onMap], [["ArrowDown"], "", () => map.pan(0, -80), onMap],
      [["ArrowLeft"], "", () => map.pan(80, 0), onMap], [["ArrowRight"], "", () => map.pan(-80, 0), onMap],
    ]],
    ["Everywhere", [
      [["q"], "review", () => app.show("review"), {}], [["p"], "map", () => app.show("map"), {}], [["f"], "link and fleet", () => app.show("fleet"), {}],
      [["x"], "exports", () => app.exports(), {}], [["t"], "day or night", () => app.toggleTheme(), {}], [["z"], "type size", () => app.toggleTypeSize(), {}],
      [["?"], "this help", () => app.help(), {}],
      [["Escape"], "leave a field, remove a point, end a measurement", () => app.escape(), {}],
    ]],
  ];
}

/** Handle the keys of a table; `activeView()` returns the name of the displayed view. */
export function startShortcuts(keys, activeView, { leave, send }) {
  const actions = keys.flatMap(([, list]) => list);
  document.addEventListener("keydown", (event) => {
    if (document.querySelector("dialog[open]")) return;
    if (isTextField(event.target)) {
      if (event.key === "Escape") leave();
      if (event.key === "Enter" && event.ctrlKey) send();
      return;
    }
    if (event.ctrlKey || event.metaKey) return;
    // Buttons handle Enter, and sliders handle arrow keys.
    if (event.key === "Enter" && ["BUTTON", "A", "SUMMARY"].includes(event.target.tagName)) return;
    if (event.key.startsWith("Arrow") && event.target.tagName === "INPUT") return;
    const found = actions.find(([names, , , options]) => names.includes(event.key) && (!options.view || options.view === activeView()));
    if (!found) return;
    event.preventDefault();
    found[2](event);
  });
}

export function showHelp(keys) {
  const groups = keys.map(([title, list]) => [h("h3", { text: title }), list.filter(([, text]) => text).map(([names, text, , options]) => h("div", {},
    h("span", { text }), h("span", {}, (options.label ? [options.label] : names).map((name) => [h("kbd", { text: name }), " "]))))]);
  return showDialog("Keys", h("div", { class: "keys" }, groups), [{ label: "Close", value: null, primary: true }]);
}
