// Elements without markup: untrusted text always becomes a text node.

import { emit, state } from "./state.js";
import { t } from "../texts.js";

/**
 * Create an element.
 *
 * `props`: `class`, `text`, `on` (listeners by event), `data` (data-* attributes), properties of form elements
 * (`value`, `checked`, `disabled`), and attributes by name; null, undefined and false are omitted.
 */
export function h(tag, props = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "class") element.className = value;
    else if (name === "text") element.textContent = value;
    else if (name === "on") for (const [event, handler] of Object.entries(value)) element.addEventListener(event, handler);
    else if (name === "data") Object.assign(element.dataset, value);
    else if (["value", "checked", "disabled", "open"].includes(name)) element[name] = value;
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** Replace the content of an element. */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** Show a message in the line at the foot for some seconds, an error longer. It replaces the previous message. */
export function toast(message, { bad = false } = {}) {
  const note = h("p", { class: bad ? "bad" : "", text: message, title: message });
  fill(document.getElementById("toasts"), note);
  setTimeout(() => note.remove(), bad ? 9000 : 4500);
}

export const showError = (/** @type {Error} */ error) => toast(error.message, { bad: true });

const reloadSoon = debounce(() => { if (state.online || state.refused) emit("reload"); }, 1000);

/** Report that displayed data could not be updated. Without a response, all data is loaded again; after an interruption, by the event stream. */
export function notUpdated(error) {
  showError(error);
  if (error.status === 0) reloadSoon();
}

/**
 * Show a modal dialog. Resolves to the value of the chosen action, or null if it was closed.
 *
 * `actions`: [{label, value, primary, disabled, run}], by default "Close"; `run()`, which may be asynchronous, returns
 * whether the dialog closes. The chosen input of the body, or that with `autofocus`, has the focus, otherwise the primary action, in a
 * dialog with a scroll bar its title. Enter in a field of the body is the primary action.
 *
 * @param {string} title
 * @param {any} body
 * @param {{label: string, value: any, primary?: boolean, disabled?: boolean, run?: () => any}[]} [actions]
 */
export function showDialog(title, body, actions = [{ label: t("dialog.close"), value: null, primary: true }]) {
  return new Promise((resolve) => {
    const dialog = h("dialog", { "aria-labelledby": "dialog-title" });
    const close = (value) => { dialog.close(); dialog.remove(); resolve(value); };
    const buttons = actions.map((action) => h("button", {
      type: "button", class: action.primary ? "primary" : "", disabled: action.disabled, text: action.label,
      data: { action: String(action.value) }, on: { click: async (event) => {
        event.currentTarget.disabled = Boolean(action.run);
        if (!action.run || await action.run()) close(action.value);
        else buttons.forEach((button, i) => { button.disabled = Boolean(actions[i].disabled); });
      } },
    }));
    const heading = h("h2", { id: "dialog-title", tabindex: -1, text: title });
    dialog.append(heading, ...[body].flat(), h("div", { class: "actions" }, buttons));
    dialog.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || event.target.tagName !== "INPUT") return;
      event.preventDefault();
      buttons.find((button, i) => actions[i].primary && !button.disabled)?.click();
    });
    dialog.addEventListener("cancel", (event) => { event.preventDefault(); close(null); });
    document.body.append(dialog);
    dialog.showModal();
    const chosen = dialog.querySelector("input:checked:enabled, [autofocus]");
    const primary = buttons.find((_, i) => actions[i].primary && !actions[i].disabled) ?? buttons[0];
    (chosen ?? (dialog.scrollHeight > dialog.clientHeight ? heading : primary))?.focus();
  });
}

/** A `<label>` with its text before the field. */
export function labelled(text, field, props = {}) {
  return h("label", props, h("span", { text }), field);
}

/** Combine repeated calls to one, `wait_ms` after the last call, at the latest `max_ms` after the first. */
export function debounce(handler, wait_ms, max_ms = wait_ms) {
  let timer = 0;
  let first = 0;
  return () => {
    const now = performance.now();
    if (!timer) first = now;
    clearTimeout(timer);
    timer = setTimeout(() => { timer = 0; handler(); }, Math.max(0, Math.min(wait_ms, first + max_ms - now)));
  };
}
