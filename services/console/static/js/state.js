// What all views share: who is here, what the server is, whether it is heard, and where messages between views go.

export const state = {
  session: null,
  info: null,
  online: true,
  heard_ms: 0, // performance.now() when the server was last heard
  offset_s: 0, // the server's clock less this computer's
  total: 0,
  unreviewed: 0,
  selected: null, // id of the contact in the contact view
  fleet: null,
};

const bus = new EventTarget();

/** Tell whoever listens. Names: those of the server's events, `online`, `select`, `view`, `theme`, `reload`. */
export function tell(name, detail = {}) {
  bus.dispatchEvent(new CustomEvent(name, { detail }));
}

export function listen(name, handler) {
  bus.addEventListener(name, (event) => handler(event.detail));
}

/** The server's time now, in seconds since 1970. */
export const now = () => Date.now() / 1000 + state.offset_s;

export function clockIs(now_utc_s) {
  if (Number.isFinite(now_utc_s)) state.offset_s = now_utc_s - Date.now() / 1000;
}

/** A setting of this browser; where it keeps none (a private window), of this page. */
const kept = new Map();
export function setting(name, value) {
  const key = `sonarpost.${name}`;
  if (value !== undefined) {
    kept.set(key, String(value));
    try { localStorage.setItem(key, value); } catch { /* kept for this page alone */ }
  }
  if (kept.has(key)) return kept.get(key);
  try { return localStorage.getItem(key); } catch { return null; }
}
