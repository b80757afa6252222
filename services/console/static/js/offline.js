// The page that the service worker shows when the server is not reached.

import { restoreTheme } from "./shell/header.js";
import { setting } from "./base/state.js";
import { loadLanguage, translate } from "./texts.js";

restoreTheme();
await loadLanguage(setting("language"));
translate(document);
document.getElementById("server").textContent = location.host;
document.getElementById("again").addEventListener("click", () => location.reload());
