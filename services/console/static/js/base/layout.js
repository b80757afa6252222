// Layout of the review page on small screens: menus, drawers and swipe. The CSS files decide which of them are in use.

import { h } from "./dom.js";
import { t } from "../texts.js";

const SWIPE_PX = 60;

/**
 * Join a button to an element that it opens and closes, as a menu or a drawer.
 *
 * Escape and a click outside close it. Returns `{button, open, close}`.
 *
 * @param {HTMLElement} button
 * @param {HTMLElement} element
 * @param {{within?: HTMLElement, changed?: (open: boolean) => void}} options
 */
export function opener(button, element, { within = element, changed = () => {} } = {}) {
  const isOpen = () => element.classList.contains("open");
  const set = (open) => {
    if (isOpen() === open) return;
    element.classList.toggle("open", open);
    button.setAttribute("aria-expanded", String(open));
    changed(open);
  };
  button.setAttribute("aria-expanded", "false");
  button.addEventListener("click", () => set(!isOpen()));
  const isWithin = (/** @type {HTMLElement} */ area, /** @type {Event} */ event) => area.contains(/** @type {Node} */ (event.target));
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !isOpen() || document.querySelector("dialog[open]")) return;
    if (!isWithin(within, event) && event.target !== button && event.target !== document.body) return;
    event.stopPropagation();
    set(false);
    button.focus();
  }, { capture: true });
  document.addEventListener("pointerdown", (event) => {
    if (isOpen() && !isWithin(within, event) && !isWithin(button, event)) set(false);
  });
  return { button, open: () => set(true), close: () => set(false) };
}

/** Swipe to the left or right with one finger or pen; `allowed()` is asked at its start, `moved(1 or -1)` called at its end. */
export function onSwipe(element, allowed, moved) {
  const fingers = new Map(); // pointer → start
  let start = null;
  element.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse") return;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    start = fingers.size === 1 && allowed() ? fingers.get(event.pointerId) : null;
  });
  const end = (event) => {
    fingers.delete(event.pointerId);
    const from = start;
    start = null;
    if (!from || event.type !== "pointerup" || !allowed()) return;
    const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
    if (Math.abs(dx) > SWIPE_PX && Math.abs(dx) > 2 * Math.abs(dy)) moved(dx < 0 ? 1 : -1);
  };
  addEventListener("pointerup", end);
  addEventListener("pointercancel", end);
}

/** The panel of decision and details: beside the image, or a bar at the foot that opens to a drawer. */
export class Drawer {
  constructor(panel) {
    const button = h("button", { type: "button", class: "drawer-button in-bar", "aria-label": t("layout.details"), title: t("layout.details") },
      h("span", { "aria-hidden": "true", text: "▴" }), h("span", { class: "label", text: t("layout.details") }));
    panel.append(button);
    this.open = opener(button, panel).open;
  }

  /** Focus a field, which may be in the closed drawer. */
  focus(field) {
    if (!field.checkVisibility()) this.open();
    field.focus();
  }
}
