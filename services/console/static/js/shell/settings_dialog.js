// The settings dialog: language, theme, type size, keys.

import { h, fill, labelled, showDialog } from "../base/dom.js";
import { setTheme, setTypeSize } from "./header.js";
import { conflictingRow, isChangeable, keySettings, keysOf, storeKeys } from "../base/keys.js";
import { sendSettings } from "../base/settings.js";
import { setting } from "../base/state.js";
import { LANGUAGES, t } from "../texts.js";

function choice(text, options, value, changed) {
  const field = h("select", { on: { change: () => changed(field.value) } }, options.map(([name, label]) => h("option", { value: name, text: label })));
  field.value = value;
  return labelled(text, field);
}

async function setLanguage(language) {
  setting("language", language);
  await sendSettings();
  location.reload();
}

/** Fields of all keys that can be changed; a key that another action uses is refused by the name of that action. */
function keyFields(table) {
  const rows = table.flatMap(([, list]) => list);
  const problem = h("p", { class: "bad", role: "alert" });
  const fields = h("div", { class: "keys" });
  const assign = (row, field) => {
    const key = [...field.value.trim()].at(-1);
    const present = keysOf(row, { ...keySettings(), off: false })[0];
    if (key === undefined || key === present) return;
    const { off, keys } = keySettings();
    const other = conflictingRow(rows, row, key);
    problem.textContent = other ? t("settings.conflict", { key, action: t(other[1]) }) : "";
    if (!other) {
      const changed = { ...keys, [row[1]]: key };
      if (row[0].includes(key)) delete changed[row[1]];
      storeKeys({ off, keys: changed });
    }
    draw();
    fields.querySelector(`[data-action="${CSS.escape(row[1])}"]`)?.select();
  };
  const draw = () => {
    const { off } = keySettings();
    const shown = { ...keySettings(), off: false };
    fill(fields, table.map(([title, list]) => {
      const changeable = list.filter(isChangeable);
      return changeable.length ? [h("h3", { text: t(title) }), changeable.map((row) => {
        const field = h("input", {
          class: "key-field", autocomplete: "off", value: keysOf(row, shown)[0], disabled: off, data: { action: row[1] },
          on: { focus: () => field.select(), input: () => assign(row, field), blur: () => { field.value = keysOf(row, { ...keySettings(), off: false })[0]; } },
        });
        return h("label", {}, h("span", { text: t(row[1]) }), field);
      })] : null;
    }));
  };
  const off = h("input", { type: "checkbox", id: "keys-off", checked: keySettings().off, on: { change: () => { storeKeys({ ...keySettings(), off: off.checked }); draw(); } } });
  const reset = h("button", { type: "button", id: "keys-reset", text: t("settings.reset"), on: { click: () => { storeKeys({ off: false, keys: {} }); off.checked = false; problem.textContent = ""; draw(); } } });
  draw();
  return [h("p", {}, h("label", {}, off, " ", t("settings.keys_off")), " ", reset), problem, fields];
}

/** Show the settings; each change applies at once. */
export function openSettings(table) {
  const { theme, type } = document.documentElement.dataset;
  const closed = showDialog(t("settings.title"), h("div", { class: "settings" },
    h("div", { class: "choices" },
      choice(t("settings.language"), Object.entries(LANGUAGES), document.documentElement.lang, setLanguage),
      choice(t("settings.theme"), ["day", "night"].map((name) => [name, t(`settings.theme.${name}`)]), theme, setTheme),
      choice(t("settings.type"), ["normal", "large"].map((name) => [name, t(`settings.type.${name}`)]), type, setTypeSize)),
    h("h3", { text: t("settings.keys") }), keyFields(table)),
  [{ label: t("settings.close"), value: null, primary: true }]);
  document.querySelector(".settings select").focus();
  return closed;
}
