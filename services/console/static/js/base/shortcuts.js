// Keyboard shortcuts, in one table for the event handler and the help; single-character keys can be switched off.

import { h, showDialog } from "./dom.js";
import { setting } from "./state.js";
import { t } from "../texts.js";

/**
 * @typedef {(event: KeyboardEvent) => void} Handler
 * @typedef {object} Shortcut A row of the table.
 * @property {string[]} keys Names of keys as in `KeyboardEvent.key`; the digits 0 to 3 are keys of any keyboard layout.
 * @property {string} name Name of a text that states what the key does.
 * @property {string} [label] Name of a text that the help shows in place of the keys.
 * @property {boolean} [repeats] Whether a held key repeats the action. All others act once for each press.
 * @property {Handler} [review] Action in the review.
 * @property {Handler} [map] Action on the map.
 * @property {Handler} [always] Action in all views.
 */

const TYPES = new Set(["text", "search", "password", "datetime-local", ""]);
const ARROWS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };

/** Whether the focused element accepts text. */
export function isTextField(target) {
  return target.tagName === "TEXTAREA" || target.tagName === "SELECT" || (target.tagName === "INPUT" && TYPES.has(target.type));
}

/** Whether the user has switched off the single-character keys. */
export const keysOff = () => setting("keys") === "off";

/** Switch the single-character keys on or off. The buttons of the page show no keys that are off. */
export function switchKeys(off = keysOff()) {
  if (off !== keysOff()) setting("keys", off ? "off" : "on");
  document.body.dataset.keys = off ? "off" : "on";
}

/**
 * Table of keys: [name of the group's text, rows].
 *
 * @returns {[string, Shortcut[]][]}
 */
export function shortcutTable({ app, queue, view, decision, map }) {
  const arrow = (event) => {
    const [rows, columns] = ARROWS[event.key];
    const far = event.shiftKey ? 5 : event.altKey ? 0.2 : 1;
    if (view.measurement.active) view.measurement.move(...view.views[0].turned(rows * far, columns * far));
    else if (document.activeElement?.id === "queue" && (queue.horizontal ? columns : rows)) queue.move(rows + columns);
    else view.pan(0.1 * columns, 0.1 * rows);
  };
  const pan = (event) => map.pan(-80 * ARROWS[event.key][1], -80 * ARROWS[event.key][0]);
  return [
    ["shortcuts.queue", [
      { keys: ["j"], name: "shortcuts.queue.next", repeats: true, review: () => queue.move(1), map: () => map.move(1) },
      { keys: ["k"], name: "shortcuts.queue.previous", repeats: true, review: () => queue.move(-1), map: () => map.move(-1) },
      { keys: ["n"], name: "shortcuts.queue.next_unreviewed", review: () => app.nextUnreviewed() },
      { keys: ["o"], name: "shortcuts.queue.next_look", review: () => app.nextLook() },
      { keys: ["/"], name: "shortcuts.queue.search", review: () => app.search() },
    ]],
    ["shortcuts.decision", [
      { keys: ["1"], name: "verdict.mine_like", review: () => app.decide("mine_like") },
      { keys: ["2"], name: "verdict.not_mine_like", review: () => app.decide("not_mine_like") },
      { keys: ["3"], name: "verdict.unsure", review: () => app.decide("unsure") },
      { keys: ["u"], name: "shortcuts.undo", review: () => app.undo() },
      { keys: ["w"], name: "shortcuts.decision.remark", review: () => app.drawer.focus(decision.remark) },
      { keys: ["r"], name: "shortcuts.decision.request", review: () => app.request() },
    ]],
    ["shortcuts.image", [
      { keys: ["m"], name: "shortcuts.image.measure", review: () => view.startMeasurement() },
      { keys: [","], name: "shortcuts.image.darker", repeats: true, review: () => view.changeGain(-1) },
      { keys: ["."], name: "shortcuts.image.brighter", repeats: true, review: () => view.changeGain(1) },
      { keys: ["a"], name: "shortcuts.image.auto_gain", review: () => view.changeGain(0) },
      { keys: ["+"], name: "shortcuts.image.zoom_in", repeats: true, review: () => view.zoom(1.5), map: () => map.zoom(1.5) },
      { keys: ["-"], name: "shortcuts.image.zoom_out", repeats: true, review: () => view.zoom(1 / 1.5), map: () => map.zoom(1 / 1.5) },
      { keys: ["0"], name: "shortcuts.image.whole", review: () => view.fit(), map: () => map.fit() },
      { keys: Object.keys(ARROWS), name: "shortcuts.image.move", label: "shortcuts.arrows", repeats: true, review: arrow, map: pan },
      { keys: ["v"], name: "keys.view", review: () => view.nextOrientation() },
      { keys: ["s"], name: "shortcuts.image.compare", review: () => view.toggleCompare() },
    ]],
    ["shortcuts.all", [
      { keys: ["q"], name: "shortcuts.all.review", always: () => app.show("review") },
      { keys: ["p"], name: "shortcuts.all.view_map", always: () => app.show("map") },
      { keys: ["f"], name: "shortcuts.all.fleet", always: () => app.show("fleet") },
      { keys: ["Enter"], name: "shortcuts.enter", review: () => app.enter(), map: () => map.open() },
      { keys: ["?"], name: "shortcuts.all.help", always: () => app.help() },
      { keys: ["Escape"], name: "shortcuts.all.escape", always: () => app.escape() },
    ]],
  ];
}

/** Name of the pressed key. The digits 0 to 3 are found by their place: on a French keyboard they need Shift. */
function keyName(event) {
  const digit = /^Digit([0-3])$/.exec(event.code)?.[1];
  return digit && !event.altKey && !event.getModifierState("AltGraph") ? digit : event.key;
}

/**
 * Handle the keys of a table.
 *
 * @param {[string, Shortcut[]][]} table
 * @param {() => string} activeView Returns the name of the displayed view.
 * @param {() => void} leave Called for Escape in a text field.
 */
export function startShortcuts(table, activeView, leave) {
  const rows = table.flatMap(([, list]) => list);
  document.addEventListener("keydown", (event) => {
    if (document.querySelector("dialog[open]")) return;
    if (isTextField(event.target)) {
      if (event.key === "Escape") leave();
      return;
    }
    if (event.ctrlKey || event.metaKey) return;
    // Buttons handle Enter, and sliders handle arrow keys.
    const { tagName } = /** @type {Element} */ (event.target);
    if (event.key === "Enter" && ["BUTTON", "A", "SUMMARY"].includes(tagName)) return;
    if (event.key.startsWith("Arrow") && tagName === "INPUT") return;
    const key = keyName(event);
    if (key.length === 1 && keysOff()) return;
    const row = rows.find(({ keys }) => keys.includes(key));
    const handler = row?.[activeView()] ?? row?.always;
    if (!handler) return;
    event.preventDefault();
    if (!event.repeat || row.repeats) handler(event);
  });
}

/** Show the keys. */
export function showHelp(table) {
  const names = (row) => (row.label ? [t(row.label)] : row.keys);
  const groups = table.map(([title, list]) => [h("h3", { text: t(title) }), list.map((row) => h("div", {},
    h("span", { text: t(row.name) }), h("span", {}, names(row).map((name) => [h("kbd", { text: name }), " "]))))]);
  return showDialog(t("shortcuts.title"), [keysOff() ? h("p", { text: t("shortcuts.off") }) : null, h("div", { class: "keys" }, groups)].filter(Boolean));
}
