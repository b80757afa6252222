// The page on which people change their own password. What is typed here goes to the server and nowhere else.

import { api, useToken } from "./api.js";
import { account, restoreLook } from "./bar.js";
import { state } from "./state.js";

const FIELDS = ["old", "new", "again"];

restoreLook();
const form = document.getElementById("change");
const problem = document.getElementById("problem");
const done = document.getElementById("done");
const value = (name) => form.elements[name].value;

/** Say beside a field what is wrong with it; no words for nothing. */
function say(name, words) {
  document.getElementById(`${name}-problem`).textContent = words;
  if (words) form.elements[name].setAttribute("aria-invalid", "true");
  else form.elements[name].removeAttribute("aria-invalid");
}

/** What the server need not be asked for, by field. */
function wrong() {
  const [least, most] = state.info.password_characters;
  const length = [...value("new")].length; // as the server counts: characters, not halves of them
  return {
    old: value("old") ? "" : "your present password is missing",
    new: length >= least && length <= most ? "" : `a password has ${least} to ${most} characters; this one has ${length}`,
    again: value("again") === value("new") ? "" : "the two new passwords differ",
  };
}

/** Say what is wrong, and go to the first field that is. */
function refuse(words) {
  for (const name of FIELDS) say(name, words[name] ?? "");
  form.elements[FIELDS.find((name) => words[name])]?.focus();
}

let busy = false;

async function change() {
  problem.textContent = done.textContent = "";
  const words = wrong();
  refuse(words);
  if (FIELDS.some((name) => words[name])) return;
  busy = true;
  try {
    await api.password(value("old"), value("new"));
    for (const name of FIELDS) form.elements[name].value = "";
    done.textContent = "Your password is changed. You stay logged in here; your other sessions have ended.";
    done.focus();
  } catch (error) {
    const field = error.body?.error?.field;
    if (FIELDS.includes(field)) refuse({ [field]: error.message });
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
form.addEventListener("input", (event) => say(event.target.name, ""));

try {
  [state.session, state.info] = await Promise.all([api.session(), api.info()]);
  useToken(state.session.csrf);
  form.elements.user.value = state.session.user;
  document.getElementById("platform").textContent = state.info.platform_id;
  document.getElementById("new-hint").textContent = `${state.info.password_characters.join(" to ")} characters`;
  document.getElementById("bar").append(...account());
  form.querySelector("button").disabled = false;
} catch (error) {
  problem.textContent = error.message;
}
