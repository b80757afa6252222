// Keyboard shortcuts, in one table for the event handler and the help.

import { h, showDialog } from "./dom.js";
import { keySettings, keysOf } from "./keys.js";
import { t } from "../texts.js";

const TYPES = new Set(["text", "search", "password", ""]);

/** Whether the focused element accepts text. */
export function isTextField(target) {
  return target.tagName === "TEXTAREA" || target.tagName === "SELECT" || (target.tagName === "INPUT" && TYPES.has(target.type));
}

/**
 * Table of keys: [group, [[keys, name, handler, {view, label}]]].
 *
 * `group` and `name` are names of texts; the settings store a changed key by its `name`, which is empty for a row that
 * the help leaves out. `view`: the only view in which the key is active. `label`: name of a text in place of the keys.
 */
export function shortcutTable({ app, queue, view, decision, map }) {
  const review = { view: "review" };
  const onMap = { view: "map" };
  const arrow = (rows, columns) => (event) => {
    const far = event.shiftKey ? 5 : event.altKey ? 0.2 : 1;
    if (view.measurement.active) view.measurement.move(...view.views[0].turned(rows * far, columns * far));
    else if (document.activeElement?.id === "queue" && (queue.horizontal ? columns : rows)) queue.move(rows + columns);
    else view.pan(0.1 * columns, 0.1 * rows);
  };
  return [
    ["shortcuts.queue", [
      [["j"], "shortcuts.queue.next", () => queue.move(1), review],
      [["k"], "shortcuts.queue.previous", () => queue.move(-1), review],
      [["n"], "shortcuts.queue.next_unreviewed", () => app.nextUnreviewed(), review],
      [["o"], "shortcuts.queue.next_look", () => app.nextLook(), review],
      [["O"], "object.key", () => app.openObject(), review],
      [["/"], "shortcuts.queue.search", () => app.search(), review],
      [["l"], "shortcuts.queue.unreviewed", () => app.toggleReview(), review],
    ]],
    ["shortcuts.decision", [
      [["1"], "shortcuts.decision.mine_like", () => app.decide("mine_like"), review],
      [["2"], "shortcuts.decision.not_mine_like", () => app.decide("not_mine_like"), review],
      [["3"], "shortcuts.decision.unsure", () => app.decide("unsure"), review],
      [["Shift+1"], "", () => app.choose("mine_like"), review], [["Shift+2"], "", () => app.choose("not_mine_like"), review],
      [["Shift+3"], "shortcuts.select", () => app.choose("unsure"), { view: "review", label: "shortcuts.shift" }],
      [["Enter"], "shortcuts.enter", () => app.enter(), review],
      [["y"], "shortcuts.class", () => app.drawer.focus(decision.mloClass.choice), review],
      [["g"], "shortcuts.decision.confidence", () => app.drawer.focus(decision.confidence), review],
      [["w"], "shortcuts.decision.remark", () => app.drawer.focus(decision.remark), review],
      [["u"], "shortcuts.undo", () => app.undo(), review],
      [["r"], "shortcuts.decision.request", () => app.request(), review],
    ]],
    ["shortcuts.image", [
      [["m"], "shortcuts.image.measure", () => view.startMeasurement(), review],
      [["4"], "keys.length", () => view.startMeasurement("length"), review],
      [["5"], "keys.width", () => view.startMeasurement("width"), review],
      [["6"], "keys.shadow", () => view.startMeasurement("shadow"), review],
      [["7"], "region_request.key", () => app.region(), review],
      [["+", "="], "shortcuts.image.zoom_in", () => view.zoom(1.5), review],
      [["-"], "shortcuts.image.zoom_out", () => view.zoom(1 / 1.5), review],
      [["0"], "shortcuts.image.whole", () => view.fit(), review],
      [["ArrowUp"], "", arrow(-1, 0), review], [["ArrowDown"], "", arrow(1, 0), review], [["ArrowLeft"], "", arrow(0, -1), review],
      [["ArrowRight"], "shortcuts.image.move", arrow(0, 1), { view: "review", label: "shortcuts.arrows" }],
      [["["], "shortcuts.image.older", () => view.stepVersion(-1), review],
      [["]"], "shortcuts.image.newer", () => view.stepVersion(1), review],
      [["e"], "shortcuts.image.layer", () => view.nextLayer(), review],
      [["s"], "shortcuts.image.compare", () => view.nextCompare(), review],
      [["c"], "shortcuts.image.map", () => view.nextMap(1), review],
      [[","], "shortcuts.image.darker", () => view.changeGain(-1), review],
      [["."], "shortcuts.image.brighter", () => view.changeGain(1), review],
      [["a"], "shortcuts.image.auto_gain", () => view.changeGain(0), review],
      [["h"], "shortcuts.image.hatch", () => view.toggleHatch(), review],
      [["<"], "keys.black_down", () => view.changeBlack(-1), review],
      [[">"], "keys.black_up", () => view.changeBlack(1), review],
      [["("], "keys.gamma_down", () => view.changeGamma(-1), review],
      [[")"], "keys.gamma_up", () => view.changeGamma(1), review],
      [["I"], "keys.display", () => view.toggleDisplayPanel(), review],
      [["#"], "keys.grid", () => view.toggleGrid(), review],
      [["d"], "keys.smooth", () => view.toggleSmooth(), review],
      [["b"], "keys.ground", () => view.toggleGround(), review],
      [["v"], "keys.view", () => view.nextOrientation(), review],
      [["'"], "keys.loupe", () => view.toggleLoupe(), review],
    ]],
    ["shortcuts.map", [
      [["j"], "shortcuts.map.next", () => map.move(1), onMap], [["k"], "shortcuts.map.previous", () => map.move(-1), onMap],
      [["Enter"], "shortcuts.map.open", () => map.open(), onMap],
      [["1"], "", () => map.open(), onMap], [["2"], "", () => map.open(), onMap], [["3"], "", () => map.open(), onMap],
      [["r"], "map.request", () => map.request(), onMap], [["m"], "map.measure", () => map.measure(), onMap],
      [["+", "="], "shortcuts.map.zoom_in", () => map.zoom(1.5), onMap], [["-"], "shortcuts.map.zoom_out", () => map.zoom(1 / 1.5), onMap], [["0"], "shortcuts.map.fit", () => map.fit(), onMap],
      [["ArrowUp"], "", () => map.pan(0, 80), onMap], [["ArrowDown"], "", () => map.pan(0, -80), onMap],
      [["ArrowLeft"], "", () => map.pan(80, 0), onMap], [["ArrowRight"], "", () => map.pan(-80, 0), onMap],
    ]],
    ["shortcuts.all", [
      [["q"], "shortcuts.all.review", () => app.show("review"), {}], [["p"], "shortcuts.all.view_map", () => app.show("map"), {}], [["f"], "shortcuts.all.fleet", () => app.show("fleet"), {}],
      [["M"], "shortcuts.all.mission", () => app.show("mission"), {}],
      [["x"], "shortcuts.all.exports", () => app.exports(), {}], [["t"], "shortcuts.all.theme", () => app.toggleTheme(), {}], [["z"], "shortcuts.all.type", () => app.toggleTypeSize(), {}],
      [[";"], "shortcuts.all.settings", () => app.settings(), {}],
      [["?"], "shortcuts.all.help", () => app.help(), {}],
      [["Escape"], "shortcuts.all.escape", () => app.escape(), {}],
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
    // With Shift, a digit key has another character, which depends on the keyboard layout: "/" is Shift+7 on a German one.
    const digit = /^Digit([0-9])$/.exec(event.code)?.[1];
    const shifted = event.shiftKey && digit && event.key !== digit ? `Shift+${digit}` : null;
    const settings = keySettings();
    const active = actions.filter((row) => !row[3].view || row[3].view === activeView());
    const rowOf = (key) => active.find((row) => keysOf(row, settings).includes(key));
    const found = (shifted && rowOf(shifted)) ?? rowOf(event.key);
    if (!found) return;
    event.preventDefault();
    found[2](event);
  });
}

/** Show the present keys. */
export function showHelp(table) {
  const settings = keySettings();
  const keyNames = (row) => (row[3].label ? [t(row[3].label)] : keysOf(row, settings));
  const groups = table.map(([title, list]) => [h("h3", { text: t(title) }), list.filter((row) => row[1] && keyNames(row).length).map((row) => h("div", {},
    h("span", { text: t(row[1]) }), h("span", {}, keyNames(row).map((name) => [h("kbd", { text: name }), " "]))))]);
  return showDialog(t("shortcuts.title"), [settings.off ? h("p", { text: t("shortcuts.off") }) : null, h("div", { class: "keys" }, groups)].filter(Boolean), [{ label: t("shortcuts.close"), value: null, primary: true }]);
}
