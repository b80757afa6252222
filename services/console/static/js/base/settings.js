// Settings of the user: kept on the server, so that they follow the user, and in this browser by `setting()`.

import { api } from "./api.js";
import { toast } from "./dom.js";
import { listen, setting } from "./state.js";

const WAIT_MS = 200;

let names = []; // settings that the server stores; all others are of this browser
let loading = false;
const waiting = new Map();
let timer = 0;

/** Send the changed settings. */
export async function sendSettings() {
  clearTimeout(timer);
  if (!waiting.size) return;
  const settings = Object.fromEntries(waiting);
  waiting.clear();
  try {
    await api.storeSettings(settings);
  } catch (error) {
    toast(error.message, { bad: true });
  }
}

/** Use the settings that the server has stored for the user, and send later changes. */
export async function loadSettings(user) {
  const stored = await api.settings();
  names = stored.names;
  loading = true;
  // Settings of another user of this browser do not apply.
  const others = setting("user") !== null && setting("user") !== user;
  for (const name of names) {
    if (Object.hasOwn(stored.settings, name)) setting(name, stored.settings[name]);
    else if (others) setting(name, null);
  }
  setting("user", user);
  loading = false;
}

listen("setting", ({ name, value }) => {
  if (loading || !names.includes(name)) return;
  waiting.set(name, value);
  clearTimeout(timer);
  timer = setTimeout(sendSettings, WAIT_MS);
});
