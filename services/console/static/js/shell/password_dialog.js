// The dialog in which users change their own password.

import { api } from "../base/api.js";
import { h, labelled, showDialog, toast } from "../base/dom.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";

/**
 * The first error that can be found without the server: name of the field, and text; null if there is none.
 *
 * @returns {[string, string] | null}
 */
function findError({ old, new: chosen, again }) {
  const [min, max] = state.info.password_characters;
  const count = [...chosen.value].length; // code points, as the server counts them
  if (!old.value) return ["old", t("password.old_missing")];
  if (count < min || count > max) return ["new", t("password.length", { min, max, count })];
  return again.value === chosen.value ? null : ["again", t("password.differ")];
}

/** Show the dialog; it closes when the server has changed the password. */
export async function openPasswordDialog() {
  const [min, max] = state.info.password_characters;
  const problem = h("p", { id: "password-problem", class: "bad", role: "alert" });
  const input = (name, autocomplete) => h("input", { id: `password-${name}`, type: "password", autocomplete, autofocus: name === "old", "aria-describedby": "password-problem" });
  const fields = { old: input("old", "current-password"), new: input("new", "new-password"), again: input("again", "new-password") };
  const show = (name, text) => {
    problem.textContent = text;
    for (const [one, field] of Object.entries(fields)) field.setAttribute("aria-invalid", String(one === name));
    fields[name]?.focus();
  };
  const change = async () => {
    const error = findError(fields);
    if (error) { show(...error); return false; }
    try {
      await api.password(fields.old.value, fields.new.value);
    } catch (refused) {
      show(refused.body.error?.field, refused.message);
      return false;
    }
    toast(t("password.done"));
    return true;
  };
  const form = h("form", { class: "password-form" },
    h("input", { autocomplete: "username", value: state.session.user, class: "hidden" }),
    labelled(t("password.old"), fields.old), labelled(`${t("password.new")} (${t("password.hint", { min, max })})`, fields.new),
    labelled(t("password.again"), fields.again), problem);
  form.addEventListener("input", () => show("", ""));
  await showDialog(t("password.title"), form, [
    { label: t("header.menu.password"), value: "change", primary: true, run: change }, { label: t("dialog.cancel"), value: null },
  ]);
}
