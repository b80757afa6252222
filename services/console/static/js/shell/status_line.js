// The line at the foot of the page: the last decision with its take-back time, and notices of other operators' decisions.

import { api, inOrder } from "../base/api.js";
import { fill, h, notUpdated, showDialog, showError } from "../base/dom.js";
import { symbol, time, verdict } from "../base/format.js";
import { emit, listen, now, state } from "../base/state.js";
import { t } from "../texts.js";

export class StatusLine {
  /** `undo()` takes back the last decision of the user. */
  constructor(undo) {
    this.last = null; // {id, text, until_utc_s}
    this.notices = [];
    this.load = inOrder(api.notices);
    this.text = h("span", { role: "status" });
    this.seconds = h("span", { class: "number", "aria-hidden": "true" });
    this.label = h("span", {});
    this.button = h("button", { type: "button", id: "take-back", class: "hidden", on: { click: undo } }, this.label, " ", h("kbd", { text: "u" }), this.seconds);
    this.open = h("button", { type: "button", class: "hidden", text: t("status_line.open"), on: { click: () => emit("select", { id: this.last.id, name: this.last.name }) } });
    this.noticeButton = h("button", { type: "button", id: "notices", class: "hidden", on: { click: () => this.#showNotices() } });
    fill(document.getElementById("result"), this.noticeButton, this.text, this.button, this.open);
    listen("notice", ({ user }) => { if (user === state.session.user) this.loadNotices(); });
    listen("reload", () => this.loadNotices());
    // A notice ends with the dispute.
    listen("contact", ({ contact }) => { if (this.notices.some((one) => one.contact_id === contact.id)) this.loadNotices(); });
    setInterval(() => this.#count(), 250);
  }

  /** After a reload of the page: show the last decision while it can be taken back, and the notices. */
  async start() {
    if (!state.session.may.decide) return;
    const [{ decision, contact }] = await Promise.all([api.lastDecision(), this.loadNotices()]);
    if (decision?.take_back_utc_s > now()) this.sent(contact, decision);
  }

  /** A decision was stored. */
  sent(contact, decision) {
    const values = { name: contact.name, symbol: symbol(decision.verdict), verdict: verdict(decision.verdict) };
    this.#show(contact, t(contact.review === "disputed" ? "status_line.disputed" : "status_line.sent", values), decision.take_back_utc_s ?? 0);
  }

  withdrawn(contact, decision) {
    const name = decision.delivery.shore === "withdrawn" || decision.delivery.vehicle === "withdrawn" ? "status_line.taken_back" : "status_line.undone";
    this.#show(contact, t(name, { name: contact.name, symbol: symbol(contact.review), verdict: verdict(contact.review) }), null);
  }

  /** A decision was not stored; its draft is kept. */
  failed(contact, reason) {
    this.#show(contact, t("status_line.failed", { name: contact.name, reason }), null, true);
  }

  /** Drafts of an earlier page are in the form again. */
  draftsRestored(contact, count) {
    if (!this.last) this.#show(contact, t("status_line.drafts", { count, name: contact.name }), null);
  }

  #show({ id, name }, text, until_utc_s, bad = false) {
    this.last = { id, name, until_utc_s };
    this.text.textContent = text;
    this.text.className = bad ? "bad" : "";
    this.open.classList.toggle("hidden", !bad && until_utc_s !== null);
    this.button.classList.toggle("hidden", until_utc_s === null);
    this.#count();
  }

  #count() {
    if (!this.last) return;
    const left_s = Math.ceil(this.last.until_utc_s - now());
    this.label.textContent = t(left_s > 0 ? "status_line.take_back" : "status_line.undo");
    this.seconds.textContent = left_s > 0 ? ` ${left_s}\u202fs` : "";
  }

  async loadNotices() {
    try {
      ({ notices: this.notices } = await this.load());
    } catch (error) {
      notUpdated(error);
      return;
    }
    const count = this.notices.length;
    this.noticeButton.textContent = count ? `⚠ ${t("status_line.notices", { count })}` : "";
    this.noticeButton.classList.toggle("hidden", count === 0);
  }

  async #showNotices() {
    const rows = this.notices.map((one) => h("li", {},
      h("p", { text: t(`status_line.notice.${one.kind}`, { name: one.name, own: verdict(one.own_verdict), operator: one.operator, verdict: verdict(one.verdict), time: time(one.decided_utc_s) }) }),
      one.remark ? h("p", { class: "remark", text: `“${one.remark}”` }) : null,
      h("div", { class: "actions" },
        h("button", { type: "button", text: t("status_line.open_contact", { name: one.name }), on: { click: (event) => { event.target.closest("dialog").querySelector("[data-action=null]").click(); emit("select", { id: one.contact_id, name: one.name }); } } }),
        h("button", {
          type: "button", text: t("status_line.acknowledge"), data: { acknowledge: String(one.id) }, on: { click: async (event) => {
            await api.acknowledge(one.id).then(() => event.target.closest("li").remove(), showError);
          } },
        }))));
    await showDialog(t("status_line.notices_title"), h("ul", { class: "notices" }, rows));
    await this.loadNotices();
  }
}
