// Log-in page.

import { api } from "./api.js";
import { restoreTheme } from "./header.js";

restoreTheme();
const form = document.getElementById("login");
const problem = document.getElementById("problem");

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
