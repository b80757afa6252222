// Buttons for requests to the vehicle with their cost, and the state of the latest request of each kind.

import { api } from "../base/api.js";
import { fill, h, showDialog, toast } from "../base/dom.js";
import { duration, requestKind } from "../base/format.js";
import { isPending, requestState } from "./request_state.js";
import { emit, now, state } from "../base/state.js";
import { t } from "../texts.js";

const KINDS = ["refine", "wider", "revisit", "resend", "original"];
const CONFIRM_ABOVE_S = 60;
const UPDATE_MS = 10000;

/** Send a request; a costly one, or one of unknown cost, is confirmed first. */
export async function sendRequest(contact, cost) {
  if (cost.airtime_s === null || cost.airtime_s > CONFIRM_ABOVE_S) {
    const text = cost.airtime_s === null ? t("request_buttons.confirm_unknown") : t("request_buttons.confirm_cost", { time: duration(cost.airtime_s) });
    const action = await showDialog(`${contact.name}: ${requestKind(cost.kind)}`, [h("p", { text }), h("p", { class: "muted", text: cost.basis })], [
      { label: t("request_buttons.send"), value: "send", primary: true }, { label: t("request_buttons.cancel"), value: null },
    ]);
    if (action !== "send") return;
  }
  try {
    await api.request(contact.id, { kind: cost.kind, airtime_s: cost.airtime_s });
  } catch (error) {
    toast(error.message, { bad: true });
  }
  emit("changed", { id: contact.id });
}

const costText = (cost) => {
  if (cost.kind === "revisit") return t("request_buttons.and_sailing", { time: duration(cost.airtime_s) });
  return cost.airtime_s === null ? t("request_buttons.cost_unknown") : duration(cost.airtime_s);
};

export class RequestButtons {
  /** `openDialog`: shows the table of costs. */
  constructor(openDialog) {
    this.detail = null;
    this.sending = false;
    this.buttons = h("div", { class: "request-buttons", role: "group", "aria-label": t("request_buttons.title") });
    this.states = h("ul", { class: "request-states", role: "status" });
    this.menu = h("button", { type: "button", class: "request-menu", on: { click: openDialog } }, t("request_buttons.menu"), " ", h("kbd", { text: "r" }));
    this.heading = h("h3", {}, t("request_buttons.title"), " ", h("kbd", { text: "r" }));
    this.element = h("section", { class: "requests in-bar", "aria-label": t("request_buttons.title") }, this.heading, this.buttons, this.states, this.menu);
    setInterval(() => { if (this.detail) this.#draw(); }, UPDATE_MS);
  }

  show(detail) {
    this.detail = detail;
    this.#draw();
  }

  #latest(kind) {
    return this.detail.requests.find((one) => one.kind === kind) ?? null;
  }

  #draw() {
    const { contact, costs } = this.detail;
    this.element.classList.toggle("hidden", !state.session.may.request);
    // Elements are replaced only after a change: a new button would lose a click and the focus.
    const waiting = KINDS.filter((kind) => { const one = this.#latest(kind); return one && isPending(one, now()); });
    const drawn = JSON.stringify([contact.id, costs.map((one) => [one.kind, one.available, one.reason_code, costText(one)]), waiting, this.sending]);
    if (this.drawn !== drawn) {
      this.drawn = drawn;
      const focused = document.activeElement?.dataset?.request;
      fill(this.buttons, this.#buttons(contact, costs, waiting));
      if (focused) this.buttons.querySelector(`[data-request="${CSS.escape(focused)}"]`)?.focus();
    }
    fill(this.states, [...KINDS, "region"].map((kind) => this.#latest(kind)).filter(Boolean).map((one) => {
      const { text, tone } = requestState(one, contact.vehicle_id, now());
      return h("li", { data: { kind: one.kind, tone } }, h("b", { text: requestKind(one.kind) }), " ", h("span", { class: tone, text }));
    }));
  }

  #buttons(contact, costs, waiting) {
    if (costs.some((one) => one.reason_code === "no_downlink")) return [h("p", { class: "muted", text: t("request_buttons.no_downlink") })];
    return KINDS.map((kind) => costs.find((one) => one.kind === kind)).map((cost) => {
      if (cost.reason_code === "unsupported") return h("p", { class: "muted unsupported", text: t("request_buttons.unsupported", { kind: requestKind(cost.kind), vehicle: contact.vehicle_id }) });
      if (!cost.available) return null;
      return h("button", {
        type: "button", disabled: this.sending || waiting.includes(cost.kind), data: { request: cost.kind }, title: `${t(`request_dialog.${cost.kind}`)}. ${cost.basis}`,
        on: { click: () => this.#send(contact, cost) },
      }, h("span", { text: requestKind(cost.kind) }), h("span", { class: "number cost", text: costText(cost) }));
    });
  }

  async #send(contact, cost) {
    this.sending = true;
    this.#draw();
    try {
      await sendRequest(contact, cost);
    } finally {
      this.sending = false;
      this.#draw();
    }
  }
}
