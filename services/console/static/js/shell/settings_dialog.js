// The settings dialog: language and single-character keys. Theme and type size are in the menu of the header.

import { h, labelled, showDialog } from "../base/dom.js";
import { sendSettings } from "../base/settings.js";
import { keysOff, switchKeys } from "../base/shortcuts.js";
import { setting } from "../base/state.js";
import { LANGUAGES, t } from "../texts.js";

async function setLanguage(language) {
  setting("language", language);
  await sendSettings();
  location.reload();
}

/** Show the settings; each change applies at once. */
export function openSettings() {
  const languages = Object.entries(LANGUAGES).map(([value, text]) => h("option", { value, text }));
  const language = h("select", { autofocus: true, on: { change: () => setLanguage(language.value) } }, languages);
  language.value = document.documentElement.lang;
  const off = h("input", { type: "checkbox", id: "keys-off", checked: keysOff(), on: { change: () => switchKeys(off.checked) } });
  return showDialog(t("settings.title"), h("div", { class: "settings" }, labelled(t("settings.language"), language), h("p", {}, h("label", {}, off, " ", t("settings.keys_off")))));
}
