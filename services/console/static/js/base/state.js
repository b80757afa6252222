// State shared by all views, and the messages between views.

export const state = {
  session: null,
  info: null,
  online: true,
  refused: "", // why the server refuses the event stream
  last_event_ms: 0, // performance.now() of the last event of the server
  offset_s: 0, // clock of the server minus clock of this computer
  // Of the contacts in lists: all, without a decision, with a verdict that is not delivered, those of them that were
  // refused or have expired; whether acoustic frames of one were authenticated; null if it is not known.
  counts: { total: null, to_do: 0, undelivered: 0, refused: 0, authenticated: null },
  selected: null, // identifier of the displayed contact: row, heading, form and image
  fleet: null,
};

const bus = new EventTarget();

/** Send a message to all listeners: an event of the server, `online`, `counts`, `authentication`, `list` (page of the queue), `show_all`, `undelivered`, `grid`, `select`, `move`, `view`, `theme`, `setting` or `reload`. */
export function emit(name, detail = {}) {
  bus.dispatchEvent(new CustomEvent(name, { detail }));
}

export function listen(name, handler) {
  bus.addEventListener(name, (event) => handler(/** @type {CustomEvent} */ (event).detail));
}

/** Present time of the server in seconds since 1970. */
export const now = () => Date.now() / 1000 + state.offset_s;

export function setClock(now_utc_s) {
  if (Number.isFinite(now_utc_s)) state.offset_s = now_utc_s - Date.now() / 1000;
}

/** Store the counts of an event `contact` or of a list of contacts. */
export function setCounts(/** @type {typeof state.counts} */ { total, to_do, undelivered, refused, authenticated }) {
  const marksChange = state.counts.authenticated !== authenticated;
  state.counts = { total, to_do, undelivered, refused, authenticated };
  emit("counts");
  if (marksChange) emit("authentication");
}

/**
 * Read or write a setting of this browser; of this page alone if the browser stores none (private window). Null removes it.
 *
 * settings.js sends the settings that the server knows, so that they follow the user.
 */
const pageSettings = new Map();
export function setting(name, value) {
  const key = `sonarpost.${name}`;
  if (value !== undefined) {
    if (value === null) pageSettings.delete(key);
    else pageSettings.set(key, String(value));
    try {
      if (value === null) localStorage.removeItem(key);
      else localStorage.setItem(key, value);
    } catch { /* stored for this page only */ }
    emit("setting", { name, value: String(value) });
  }
  if (pageSettings.has(key)) return pageSettings.get(key);
  try { return localStorage.getItem(key); } catch { return null; }
}
