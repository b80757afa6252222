// Page for changing the own password.

import { api, setToken } from "./base/api.js";
import { accountButtons, restoreTheme } from "./shell/header.js";
import { setting, state } from "./base/state.js";
import { loadLanguage, t, translate } from "./texts.js";

const FIELDS = ["old", "new", "again"];

restoreTheme();
await loadLanguage(setting("language"));
translate(document);
const form = document.getElementById("change");
const problem = document.getElementById("problem");
const done = document.getElementById("done");
const value = (name) => form.elements[name].value;

/** Show the error of a field; an empty text removes it. */
function showError(name, text) {
  document.getElementById(`${name}-problem`).textContent = text;
  if (text) form.elements[name].setAttribute("aria-invalid", "true");
  else form.elements[name].removeAttribute("aria-invalid");
}

/** Errors that can be found without the server, by field. */
function findErrors() {
  const [min, max] = state.info.password_characters;
  const length = [...value("new")].length; // code points, as the server counts them
  return {
    old: value("old") ? "" : t("password.old_missing"),
    new: length >= min && length <= max ? "" : t("password.length", { min, max, count: length }),
    again: value("again") === value("new") ? "" : t("password.differ"),
  };
}

/** Show all errors, and focus the first invalid field. */
function showErrors(errors) {
  for (const name of FIELDS) showError(name, errors[name] ?? "");
  form.elements[FIELDS.find((name) => errors[name])]?.focus();
}

let busy = false;

async function change() {
  problem.textContent = done.textContent = "";
  const errors = findErrors();
  showErrors(errors);
  if (FIELDS.some((name) => errors[name])) return;
  busy = true;
  try {
    await api.password(value("old"), value("new"));
    for (const name of FIELDS) form.elements[name].value = "";
    done.textContent = t("password.done");
    done.focus();
  } catch (error) {
    const field = error.body?.error?.field;
    if (FIELDS.includes(field)) showErrors({ [field]: error.message });
    else problem.textContent = error.message;
    if (field === "old") form.elements.old.value = "";
  } finally {
    busy = false;
  }
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  if (!busy) change();
});
form.addEventListener("input", (event) => showError(event.target.name, ""));

try {
  [state.session, state.info] = await Promise.all([api.session(), api.info()]);
  setToken(state.session.csrf);
  form.elements.user.value = state.session.user;
  document.getElementById("platform").textContent = state.info.platform_id;
  const [min, max] = state.info.password_characters;
  document.getElementById("new-hint").textContent = t("password.hint", { min, max });
  document.getElementById("bar").append(...accountButtons());
  form.querySelector("button").disabled = false;
} catch (error) {
  problem.textContent = error.message;
}
