// The event stream of the server, and the state of its connection.

import { api } from "./api.js";
import { emit, setClock, setCounts, state } from "./state.js";

const NAMES = ["contact", "notice", "fleet", "session", "clock"];
const SILENT_MS = 10000; // the server sends its time every 5 s
const RETRY_MS = 2000;

let source = null;
let lastId = "";
let opened_ms = 0;
let reload = false;
let checking = false;
let retry_ms = RETRY_MS;

function received(event) {
  state.last_event_ms = performance.now();
  if (event.lastEventId) lastId = event.lastEventId;
  if (state.online) return;
  state.online = true;
  state.refused = "";
  emit("online");
}

/** No events arrive: without connection, or because the server refuses the stream (`refused`: its reason). */
function lost(refused = "") {
  if (!state.online && state.refused === refused) return;
  state.online = false;
  state.refused = refused;
  emit("online");
}

const streamUrl = () => `/events?last=${encodeURIComponent(lastId)}`;

function open() {
  source?.close();
  opened_ms = performance.now();
  source = new EventSource(streamUrl());
  source.addEventListener("hello", (event) => {
    received(event);
    retry_ms = RETRY_MS;
    setClock(JSON.parse(event.data).now_utc_s);
    if (reload) emit("reload");
    reload = false;
  });
  source.addEventListener("reset", (event) => { received(event); emit("reload"); });
  for (const name of NAMES) {
    source.addEventListener(name, (event) => {
      received(event);
      const detail = JSON.parse(event.data);
      if (name === "clock") setClock(detail.now_utc_s);
      if (name === "contact") setCounts(detail);
      emit(name, detail);
    });
  }
  source.addEventListener("error", () => {
    // The browser reconnects unless it received an error response, for example from a proxy.
    reload = true;
    if (source.readyState === EventSource.CLOSED) explain();
    else lost();
  });
}

/** Ask the server why it refuses the stream; returns whether it does, and waits as long as it says. */
async function explain() {
  if (checking) return true;
  checking = true;
  const error = await api.streamError(streamUrl());
  checking = false;
  opened_ms = performance.now();
  if (error === null) {
    lost();
    return false;
  }
  if (error.status === 401) emit("session");
  lost(error.message);
  retry_ms = Math.max(RETRY_MS, 1000 * error.retry_after_s);
  return true;
}

/** Reopen a stream that is silent or closed. */
async function check() {
  if (checking) return;
  const now_ms = performance.now();
  const silent = now_ms - Math.max(state.last_event_ms, opened_ms) > Math.max(SILENT_MS, retry_ms);
  const closed = source.readyState === EventSource.CLOSED && now_ms - opened_ms > retry_ms;
  if (silent && !closed) lost();
  if (!silent && !closed) return;
  reload = true;
  if (!(closed && (await explain()))) open();
}

/** Receive the events after those that the data of the page contains. */
export function startEvents() {
  lastId = state.info.last_event;
  state.last_event_ms = performance.now();
  open();
  setInterval(check, 1000);
  addEventListener("online", () => { reload = true; open(); });
  addEventListener("offline", () => lost());
}
