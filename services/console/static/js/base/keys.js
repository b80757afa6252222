// Keys of the user: single-character keys can be changed, or switched off.

import { setting } from "./state.js";

/** Settings of the keys: `{off, keys}` with the changed keys by name of the action. */
export function keySettings() {
  let stored = null;
  try { stored = JSON.parse(setting("keys") ?? "{}"); } catch { /* not written by this page: the default keys are used */ }
  const { off, keys } = stored ?? {};
  return { off: off === true, keys: typeof keys === "object" && keys !== null ? keys : {} };
}

/** Store the settings of the keys. */
export function storeKeys({ off, keys }) {
  setting("keys", JSON.stringify({ off, keys }));
  markKeys();
}

/** Hide the default keys on the buttons of the page if they are changed or off. */
export function markKeys() {
  const { off, keys } = keySettings();
  document.body.dataset.keys = off ? "off" : Object.keys(keys).length ? "changed" : "default";
}

/** Whether the keys of a row of the shortcut table are single characters, which can be changed. */
export const isChangeable = ([defaults, name]) => name !== "" && defaults.every((key) => key.length === 1);

/** Present keys of a row of the shortcut table; empty if they are off. */
export function keysOf(row, { off, keys } = keySettings()) {
  if (!isChangeable(row)) return row[0];
  if (off) return [];
  return Object.hasOwn(keys, row[1]) ? [String(keys[row[1]])] : row[0];
}

/** The row that uses a key in the same view as another row; null if there is none. */
export function conflictingRow(rows, row, key, settings = keySettings()) {
  const used = { ...settings, off: false };
  const view = row[3].view;
  return rows.find((one) => one !== row && one[1] !== row[1] && keysOf(one, used).includes(key) && (!view || !one[3].view || one[3].view === view)) ?? null;
}
