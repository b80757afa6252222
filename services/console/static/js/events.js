// The stream of events, and whether it still lives. What the page shows is only as fresh as this stream.

import { clockIs, state, tell } from "./state.js";

const NAMES = ["contact", "frame", "decision", "request", "advice", "fleet", "session", "clock"];
const SILENT_MS = 12000; // the server says its time every 5 s
const AGAIN_MS = 2000;

let source = null;
let last = "";
let opened_ms = 0;
let reload = false;

function heard(event) {
  state.heard_ms = performance.now();
  if (event.lastEventId) last = event.lastEventId;
  if (!state.online) {
    state.online = true;
    tell("online");
  }
}

function lost() {
  if (!state.online) return;
  state.online = false;
  tell("online");
}

function open() {
  source?.close();
  opened_ms = performance.now();
  source = new EventSource(last ? `/events?last=${encodeURIComponent(last)}` : "/events");
  source.addEventListener("hello", (event) => {
    heard(event);
    clockIs(JSON.parse(event.data).now_utc_s);
    if (reload) tell("reload");
    reload = false;
  });
  source.addEventListener("reset", (event) => { heard(event); tell("reload"); });
  for (const name of NAMES) {
    source.addEventListener(name, (event) => {
      heard(event);
      const detail = JSON.parse(event.data);
      if (name === "clock") clockIs(detail.now_utc_s);
      tell(name, detail);
    });
  }
  source.addEventListener("error", () => {
    // The browser tries again by itself unless it has given up, which it does when a proxy answers in the server's place.
    reload = true;
    lost();
  });
}

/** Look every second: a stream that says nothing is dead, whatever the browser thinks of it. */
function look() {
  const now_ms = performance.now();
  const silent = now_ms - Math.max(state.heard_ms, opened_ms) > SILENT_MS;
  const gaveUp = source.readyState === EventSource.CLOSED && now_ms - opened_ms > AGAIN_MS;
  if (silent) lost();
  if (silent || gaveUp) {
    reload = true;
    open();
  }
}

export function startEvents() {
  state.heard_ms = performance.now();
  open();
  setInterval(look, 1000);
  addEventListener("online", () => { reload = true; open(); });
  addEventListener("offline", lost);
}
