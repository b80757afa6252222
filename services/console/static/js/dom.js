// Making elements without markup: text from outside only ever becomes a text node.

/**
 * Make an element.
 *
 * `props`: `class`, `text`, `on` (listeners by event), `data` (data-* attributes), properties of form elements
 * (`value`, `checked`, `disabled`), and attributes by name; null, undefined and false leave one out.
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

/** Replace everything within an element. */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** Say something for a few seconds; errors stay longer. */
export function toast(message, { bad = false } = {}) {
  const place = document.getElementById("toasts");
  for (const old of place.children) if (old.textContent === message) old.remove();
  const note = h("p", { class: bad ? "bad" : "", text: message });
  place.append(note);
  while (place.children.length > 4) place.firstElementChild.remove();
  setTimeout(() => note.remove(), bad ? 9000 : 4500);
}

/**
 * Show a modal dialog until one of its actions is chosen; resolves to that action's value, null where it was closed.
 *
 * `actions`: [{label, value, primary, disabled}]; the primary one, or what is chosen in the body,
 * has the focus, and Enter in a field of the body is the primary action.
 */
export function ask(title, body, actions) {
  return new Promise((resolve) => {
    const dialog = h("dialog", { "aria-labelledby": "dialog-title" });
    const close = (value) => { dialog.close(); dialog.remove(); resolve(value); };
    const buttons = actions.map((action) => h("button", {
      type: "button", class: action.primary ? "primary" : "", disabled: action.disabled, text: action.label,
      data: { action: String(action.value) }, on: { click: () => close(action.value) },
    }));
    dialog.append(h("h2", { id: "dialog-title", text: title }), ...[body].flat(), h("div", { class: "actions" }, buttons));
    dialog.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || event.target.tagName !== "INPUT") return;
      event.preventDefault();
      buttons.find((button, i) => actions[i].primary && !button.disabled)?.click();
    });
    dialog.addEventListener("cancel", (event) => { event.preventDefault(); close(null); });
    document.body.append(dialog);
    dialog.showModal();
    const first = dialog.querySelector("input:checked:enabled");
    (first ?? buttons.find((_, i) => actions[i].primary && !actions[i].disabled) ?? buttons[0])?.focus();
  });
}

/** A `<label>` around its field, the label's words first. */
export function labelled(words, field, props = {}) {
  return h("label", props, h("span", { text: words }), field);
}

/** Let a burst of calls become one, after `wait_ms` of quiet, at the latest after `most_ms`. */
export function calmly(handler, wait_ms, most_ms = wait_ms) {
  let timer = 0;
  let first = 0;
  return () => {
    const now = performance.now();
    if (!timer) first = now;
    clearTimeout(timer);
    timer = setTimeout(() => { timer = 0; handler(); }, Math.max(0, Math.min(wait_ms, first + most_ms - now)));
  };
}
