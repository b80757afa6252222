// The decision that replaces those of other operators, with a reason.

import { h } from "../base/dom.js";
import { VERDICTS, symbol, verdict } from "../base/format.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";

export class OverruleForm {
  /** `send(verdict, reason)` sends the decision that replaces those of the other operators. */
  constructor(send) {
    this.shown = "";
    this.title = h("h3", {});
    this.reason = h("input", { id: "overrule-reason", maxlength: 2000, autocomplete: "off", on: { input: () => this.#update(), keydown: (event) => { if (event.key === "Enter") event.preventDefault(); } } });
    this.buttons = VERDICTS.map((name) => h("button", { type: "button", data: { overrule: name }, text: `${symbol(name)} ${verdict(name)}`, on: { click: () => send(name, this.reason.value.trim()) } }));
    this.form = h("div", {}, h("label", {}, h("span", { text: t("overrule.reason") }), this.reason), h("div", { class: "overrule-buttons" }, this.buttons));
    this.element = h("section", { class: "overrule hidden", "aria-label": t("overrule.title") }, this.title, this.form);
  }

  show({ contact, decisions, standing }, allowed) {
    const all = decisions.filter((one) => standing.includes(one.decision_id));
    this.others = all.filter((one) => one.operator !== state.session.user);
    const disputed = contact.review === "disputed";
    this.element.classList.toggle("hidden", !disputed && !(allowed && this.others.length));
    this.element.classList.toggle("disputed", disputed);
    this.title.textContent = disputed ? t("overrule.disputed") : t("overrule.of", { names: this.others.map((one) => one.operator).join(", ") });
    this.form.classList.toggle("hidden", !allowed || !this.others.length);
    const shown = `${contact.id} ${standing.join()}`;
    if (shown !== this.shown) this.reason.value = "";
    this.shown = shown;
    this.#update();
  }

  #update() {
    for (const button of this.buttons) {
      button.disabled = this.reason.value.trim() === "" || !this.others.some((one) => one.verdict !== button.dataset.overrule);
    }
  }
}
