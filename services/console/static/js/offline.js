// The page that the service worker shows when the server is not reached. It loads the wanted page when it is reached again.

import { restoreTheme } from "./shell/header.js";
import { setting } from "./base/state.js";
import { loadLanguage, translate } from "./texts.js";

const RETRY_MS = 3000;

restoreTheme();
await loadLanguage(setting("language"));
translate(document);
document.getElementById("server").textContent = location.host;
document.getElementById("again").addEventListener("click", () => location.reload());

async function retry() {
  try {
    await fetch("/login", { cache: "no-store" });
    location.reload();
  } catch {
    setTimeout(retry, RETRY_MS); // still no connection
  }
}
setTimeout(retry, RETRY_MS);
