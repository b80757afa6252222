// Buttons for requests to the vehicle with their cost, and the state of the latest request of each kind.

import { api } from "../base/api.js";
import { fill, h, showDialog, showError } from "../base/dom.js";
import { bytes, duration, percent, quantity, requestKind } from "../base/format.js";
import { isPending, requestState } from "./request_state.js";
import { emit, now, state } from "../base/state.js";
import { t } from "../texts.js";

const CONFIRM_ABOVE_S = 60;
const UPDATE_MS = 1000;

/** A rounded duration: an estimate has no single seconds. @param {number} seconds */
export const about = (seconds) => (seconds < 90 ? duration(5 * Math.ceil(seconds / 5)) : quantity(Math.round(seconds / 60), "min", 0));

/** Smallest detail now and with the answer; empty where it is not known. */
const gainText = (cost) => (cost.new_detail_m === null ? "" : t("request_buttons.gain", { now: quantity(cost.detail_m, "", 2), then: quantity(cost.new_detail_m, "m", 2) }));

function costText(cost) {
  if (cost.airtime_s === null) return t("request_buttons.cost_unknown");
  const airtime = t("request_buttons.airtime", { time: duration(cost.airtime_s) });
  if (cost.kind === "revisit") return [airtime, t("request_buttons.and_sailing")].join(" · ");
  if (cost.median_s === null) return airtime;
  const measured = cost.loss_up !== null || cost.past_requests > 0;
  return [airtime, t(measured ? "request_buttons.arrives" : "request_buttons.arrives_assumed", { time: about(cost.median_s) })].join(" · ");
}

/** On what cost and arrival rest, in sentences. */
function basisText(cost) {
  const found = [t(`request_buttons.help.${cost.kind}`)];
  if (cost.bytes > 0) found.push(t("request_buttons.bytes", { bytes: bytes(cost.bytes) }));
  if (cost.median_s !== null) {
    found.push(t("request_buttons.most", { time: about(cost.most_s) }));
    found.push(cost.loss_up === null ? t("request_buttons.no_loss") : t("request_buttons.loss_up", { share: percent(100 * cost.loss_up) }));
    found.push(t("request_buttons.loss_down", { lost: cost.packets_lost, sent: cost.packets_sent }), t("request_buttons.past", { count: cost.past_requests }));
  }
  return found.join(" ");
}

/** Send a request; a costly one, or one of unknown cost, is confirmed first. */
async function sendRequest(contact, cost) {
  if (cost.kind === "region") { emit("region"); return; }
  if (cost.airtime_s === null || cost.airtime_s > CONFIRM_ABOVE_S) {
    const text = cost.airtime_s === null ? t("request_buttons.confirm_unknown") : t("request_buttons.confirm_cost", { time: duration(cost.airtime_s) });
    const action = await showDialog(`${contact.name}: ${requestKind(cost.kind)}`, [h("p", { text }), h("p", { class: "muted", text: basisText(cost) })], [
      { label: t("request_buttons.send"), value: "send", primary: true }, { label: t("dialog.cancel"), value: null },
    ]);
    if (action !== "send") return;
  }
  await api.request(contact.id, { kind: cost.kind, airtime_s: cost.airtime_s }).catch(showError);
}

export class RequestButtons {
  constructor() {
    this.detail = null;
    this.sending = false;
    this.buttons = h("div", { class: "request-buttons", role: "group", "aria-label": t("request_buttons.title") });
    this.states = h("ul", { class: "request-states", role: "status" });
    this.menu = h("button", { type: "button", class: "request-menu", on: { click: () => this.open() } }, t("request_buttons.menu"), " ", h("kbd", { text: "r" }));
    this.heading = h("h3", {}, t("request_buttons.title"), " ", h("kbd", { text: "r" }));
    this.element = h("section", { class: "requests in-bar", "aria-label": t("request_buttons.title") }, this.heading, this.buttons, this.states, this.menu);
    setInterval(() => { if (this.detail) this.#draw(); }, UPDATE_MS);
  }

  /** Move the focus to the buttons; where there is no room for them, show them in a dialog. */
  async open() {
    if (!this.detail || !state.session.may.request) return;
    if (this.buttons.offsetParent) { this.buttons.querySelector("button:enabled")?.focus(); return; }
    const { contact, costs } = this.detail;
    const body = h("div", { class: "request-buttons", on: { click: (event) => { if (event.target.closest("[data-request]")) body.closest("dialog").querySelector(".actions button").click(); } } },
      this.#buttons(contact, costs, this.#waiting()));
    await showDialog(`${contact.name}: ${t("request_buttons.title")}`, body, [{ label: t("dialog.cancel"), value: null }]);
  }

  show(/** @type {ContactDetail} */ detail) {
    this.detail = detail;
    this.#draw();
  }

  #latest(kind) {
    return this.detail.requests.find((one) => one.kind === kind) ?? null;
  }

  #waiting() {
    const kinds = this.detail.costs.map((cost) => cost.kind).filter((kind) => kind !== "region" && this.#latest(kind));
    return kinds.filter((kind) => isPending(this.#latest(kind), now()));
  }

  #draw() {
    const { contact, costs } = this.detail;
    this.element.classList.toggle("hidden", !state.session.may.request);
    // Elements are replaced only after a change: a new button would lose a click and the focus.
    const waiting = this.#waiting();
    const drawn = JSON.stringify([contact.id, costs.map((one) => [one.kind, one.reason_code, gainText(one), costText(one)]), waiting, this.sending]);
    if (this.drawn !== drawn) {
      this.drawn = drawn;
      const focused = document.activeElement?.dataset?.request;
      fill(this.buttons, this.#buttons(contact, costs, waiting));
      if (focused) this.buttons.querySelector(`[data-request="${CSS.escape(focused)}"]`)?.focus();
    }
    this.#drawStates(contact);
  }

  /** The countdown changes every second; a screen reader reads the other texts only, when they change. */
  #drawStates(contact) {
    const found = this.detail.costs.map((cost) => this.#latest(cost.kind)).filter(Boolean).map((one) => ({ kind: one.kind, ...requestState(one, contact.vehicle_id, now()) }));
    const drawn = JSON.stringify(found.map(({ kind, text, tone }) => [kind, text, tone]));
    if (this.drawnStates !== drawn) {
      this.drawnStates = drawn;
      fill(this.states, found.map(({ kind, text, tone }) => h("li", { data: { kind, tone } },
        h("b", { text: requestKind(kind) }), " ", h("span", { class: tone, text }), h("span", { class: "countdown", "aria-hidden": "true" }))));
    }
    this.states.querySelectorAll(".countdown").forEach((element, index) => {
      const text = found[index].countdown ? `; ${found[index].countdown}` : "";
      if (element.textContent !== text) element.textContent = text;
    });
  }

  #buttons(contact, costs, waiting) {
    if (costs.some((one) => one.reason_code === "no_downlink")) return [h("p", { class: "muted", text: t("request_buttons.no_downlink") })];
    return costs.map((cost) => {
      if (cost.reason_code === "unsupported") return h("p", { class: "muted unsupported", text: t("request_buttons.unsupported", { kind: requestKind(cost.kind), vehicle: contact.vehicle_id }) });
      if (cost.reason_code !== null) return null;
      return h("button", {
        type: "button", disabled: this.sending || waiting.includes(cost.kind), data: { request: cost.kind }, title: basisText(cost),
        on: { click: () => this.#send(contact, cost) },
      }, h("span", {}, requestKind(cost.kind), " ", h("span", { class: "number gain", text: gainText(cost) })), h("span", { class: "number cost", text: costText(cost) }));
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
