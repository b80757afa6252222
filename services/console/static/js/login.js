// Log-in page: by name and password, or by a log-in link, whose token is the part of the address after "#".

import { api } from "./base/api.js";
import { restoreTheme } from "./shell/header.js";
import { setting } from "./base/state.js";
import { loadLanguage, t, translate } from "./texts.js";

restoreTheme();
await loadLanguage(setting("language"));
translate(document);
if (location.search === "?ended") document.getElementById("reason").textContent = t("login.ended");
const form = /** @type {HTMLFormElement & { elements: Record<string, HTMLInputElement> }} */ (document.getElementById("login"));
const problem = document.getElementById("problem");

/** Log in by the link, if the address is one. The token is removed from the address, and thus from the history. */
async function useLink() {
  const token = location.hash.slice(1);
  if (!token) return;
  history.replaceState(null, "", location.pathname);
  problem.textContent = t("login.link_wait");
  try {
    await api.loginLink(token);
    location.replace("/");
  } catch (error) {
    problem.textContent = error.message;
  }
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = form.querySelector("button");
  button.disabled = true;
  problem.textContent = "";
  try {
    await api.login(form.elements.user.value, form.elements.password.value);
    location.assign("/");
  } catch (error) {
    problem.textContent = error.message;
    form.elements.password.value = "";
    form.elements.password.focus();
  } finally {
    button.disabled = false;
  }
});
addEventListener("hashchange", useLink);
await useLink();
