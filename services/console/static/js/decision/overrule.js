// Standing verdicts of several operators, and the decision that replaces those of others, with a reason.

import { fill, h } from "../base/dom.js";
import { symbol, time, verdict } from "../base/format.js";
import { state } from "../base/state.js";
import { t } from "../texts.js";

const VERDICTS = ["mine_like", "not_mine_like", "unsure"];

export class OverruleForm {
  /** `send(verdict, reason)` sends the decision that replaces those of the other operators. */
  constructor(send) {
    this.shown = "";
    this.title = h("h3", {});
    this.list = h("ul", {});
    this.reason = h("input", { id: "overrule-reason", maxlength: 2000, autocomplete: "off", on: { input: () => this.#update(), keydown: (event) => { if (event.key === "Enter") event.preventDefault(); } } });
    this.buttons = VERDICTS.map((name) => h("button", { type: "button", data: { overrule: name }, text: `${symbol(name)} ${verdict(name)}`, on: { click: () => send(name, this.reason.value.trim()) } }));
    this.form = h("div", {}, h("label", {}, h("span", { text: t("overrule.reason") }), this.reason), h("div", { class: "overrule-buttons" }, this.buttons));
    this.element = h("section", { class: "overrule hidden", "aria-label": t("overrule.title") }, this.title, this.list, this.form);
  }

  show({ contact, decisions, standing }, allowed) {
    const all = decisions.filter((one) => standing.includes(one.decision_id));
    this.others = all.filter((one) => one.operator !== state.session.user);
    const disputed = contact.review === "disputed";
    this.element.classList.toggle("hidden", !disputed && !(allowed && this.others.length));
    this.element.classList.toggle("disputed", disputed);
    this.title.textContent = disputed ? t("overrule.disputed") : t("overrule.of", { names: this.others.map((one) => one.operator).join(", ") });
    fill(this.list, disputed ? all.map((one) => h("li", {},
      h("b", { text: one.operator }), " ", h("span", { class: `badge ${one.verdict}`, text: `${symbol(one.verdict)} ${verdict(one.verdict)}` }), ` ${time(one.decided_utc_s)}`,
      one.remark ? h("p", { class: "remark", text: `“${one.remark}”` }) : null)) : []);
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
