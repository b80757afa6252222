// The keys, in one table: what they do here is what the help says they do.

import { ask, h } from "./dom.js";

const TYPES = new Set(["text", "search", "password", ""]);

/** Whether letters belong to the field that has the focus. */
export function typing(target) {
  return target.tagName === "TEXTAREA" || target.tagName === "SELECT" || (target.tagName === "INPUT" && TYPES.has(target.type));
}

/** Make the table of keys: [group, [[keys, words, handler, {where, arrows}]]]. `where` names the view in which one holds. */
export function keyTable({ app, queue, view, decision, map }) {
  const review = { where: "review" };
  const onMap = { where: "map" };
  const arrow = (rows, columns) => (event) => {
    const far = event.shiftKey ? 5 : event.altKey ? 0.2 : 1;
    if (view.measuring.active) view.measuring.move(rows * far, columns * far);
    else if (document.activeElement?.id === "queue" && rows) queue.move(rows);
    else view.pan(0.1 * columns, 0.1 * rows);
  };
  return [
    ["Queue", [
      [["j"], "next contact", () => queue.move(1), review],
      [["k"], "previous contact", () => queue.move(-1), review],
      [["n"], "next unreviewed contact", () => app.nextUnreviewed(), review],
      [["o"], "next look at the same place", () => app.nextLook(), review],
      [["/"], "search", () => app.search(), review],
      [["l"], "show only what is to do, or all", () => app.toggleReview(), review],
    ]],
    ["Decision", [
      [["1"], "mine-like", () => decision.choose("mine_like"), review],
      [["2"], "not mine-like", () => decision.choose("not_mine_like"), review],
      [["3"], "unsure", () => decision.choose("unsure"), review],
      [["Enter"], "send it; set a point while measuring", () => app.enter(), review],
      [["g"], "how sure", () => decision.sure.focus(), review],
      [["w"], "write a remark (Ctrl+Enter sends)", () => decision.remark.focus(), review],
      [["u"], "undo the last decision", () => decision.undo(), review],
      [["r"], "ask for more", () => app.askForMore(), review],
    ]],
    ["Picture", [
      [["m"], "measure: length, width, shadow", () => view.measure(), review],
      [["+", "="], "zoom in", () => view.zoom(1.5), review],
      [["-"], "zoom out", () => view.zoom(1 / 1.5), review],
      [["0"], "whole picture", () => view.fit(), review],
      [["ArrowUp"], "", arrow(-1, 0), review], [["ArrowDown"], "", arrow(1, 0), review], [["ArrowLeft"], "", arrow(0, -1), review],
      [["ArrowRight"], "move picture or point", arrow(0, 1), { where: "review", shown: "arrows" }],
      [["["], "older version", () => view.stepVersion(-1), review],
      [["]"], "newer version", () => view.stepVersion(1), review],
      [["e"], "raw, enhanced, grain", () => view.nextLayer(), review],
      [["s"], "side by side", () => view.nextCompare(), review],
      [["c"], "next colour map", () => view.nextMap(1), review],
      [[",", "."], "darker, brighter", (event) => view.gain(event.key === "." ? 1 : -1), review],
      [["a"], "automatic gain", () => view.gain(0), review],
      [["h"], "hatch over missing areas", () => view.toggleHatch(), review],
    ]],
    ["Map", [
      [["j"], "next contact", () => map.move(1), onMap], [["k"], "previous contact", () => map.move(-1), onMap],
      [["Enter"], "review the chosen contact", () => map.open(), onMap],
      [["+", "="], "zoom in", () => map.zoom(1.5), onMap], [["-"], "zoom out", () => map.zoom(1 / 1.5), onMap], [["0"], "all of it", () => map.fit(), onMap],
      [["ArrowUp"], "", () => map.pan(0, 80), onMap], [["ArrowDown"], "", () => map.pan(0, -80), onMap],
      [["ArrowLeft"], "", () => map.pan(80, 0), onMap], [["ArrowRight"], "", () => map.pan(-80, 0), onMap],
    ]],
    ["Everywhere", [
      [["q"], "review", () => app.show("review"), {}], [["p"], "map", () => app.show("map"), {}], [["f"], "link and fleet", () => app.show("fleet"), {}],
      [["x"], "exports", () => app.exports(), {}], [["t"], "day or night", () => app.theme(), {}], [["z"], "type size", () => app.type(), {}],
      [["?"], "this help", () => app.help(), {}],
      [["Escape"], "leave a field, a point, measuring", () => app.escape(), {}],
    ]],
  ];
}

/** Listen to the keys of a table; `where()` names the view that is shown. */
export function startKeys(keys, where, { leave, send }) {
  const actions = keys.flatMap(([, list]) => list);
  document.addEventListener("keydown", (event) => {
    if (document.querySelector("dialog[open]")) return;
    if (typing(event.target)) {
      if (event.key === "Escape") leave();
      if (event.key === "Enter" && event.ctrlKey) send();
      return;
    }
    if (event.ctrlKey || event.metaKey) return;
    // Enter on a button is that button's; arrows on a slider are the slider's.
    if (event.key === "Enter" && ["BUTTON", "A", "SUMMARY"].includes(event.target.tagName)) return;
    if (event.key.startsWith("Arrow") && event.target.tagName === "INPUT") return;
    const found = actions.find(([names, , , options]) => names.includes(event.key) && (!options.where || options.where === where()));
    if (!found) return;
    event.preventDefault();
    found[2](event);
  });
}

export function showHelp(keys) {
  const groups = keys.map(([title, list]) => [h("h3", { text: title }), list.filter(([, words]) => words).map(([names, words, , options]) => h("div", {},
    h("span", { text: words }), h("span", {}, (options.shown ? [options.shown] : names).map((name) => [h("kbd", { text: name }), " "]))))]);
  return ask("Keys", h("div", { class: "keys" }, groups), [{ label: "Close", value: null, primary: true }]);
}
