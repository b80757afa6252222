// Air time: images that vehicles still send, their cost and gain, their order, and the air time that verdicts gave back.

import { api } from "../base/api.js";
import { fill, h, toast } from "../base/dom.js";
import { bytes, duration, verdict } from "../base/format.js";
import { listen, state } from "../base/state.js";
import { t } from "../texts.js";

const REFRESH_MS = 5000;

export class AirTimePanel {
  constructor() {
    this.dragged = null; // identifier of the dragged image
    this.busy = false;
    this.body = h("div", { class: "airtime" });
    this.element = h("section", { "aria-label": t("airtime_panel.title") }, h("h2", { text: t("airtime_panel.title") }), this.body);
    setInterval(() => this.load(), REFRESH_MS);
    listen("view", () => setTimeout(() => this.load()));
    listen("decision", () => this.load());
    listen("request", () => this.load());
  }

  get #visible() { return this.element.isConnected && this.element.offsetParent !== null; }

  async load() {
    if (!this.#visible || this.dragged || this.body.contains(document.activeElement)) return;
    await this.refresh();
  }

  async refresh() {
    try {
      this.#draw(await api.airTime());
    } catch (error) {
      if (error.status !== 0) toast(error.message, { bad: true });
    }
  }

  #draw({ vehicles, given_back: back }) {
    fill(this.body,
      h("p", { class: "given-back" }, h("b", { text: t("airtime_panel.given_back", { seconds: duration(back.total_s) }) }), " ", h("span", { class: "muted", text: t("airtime_panel.estimate") })),
      back.decisions.length ? h("ul", {}, back.decisions.slice(0, 5).map((one) => h("li", {
        text: t(one.vehicle === "confirmed" ? "airtime_panel.verdict_confirmed" : "airtime_panel.verdict_waiting", { name: one.name, verdict: verdict(one.verdict), seconds: duration(one.seconds) }),
      }))) : null,
      vehicles.map((one) => this.#vehicle(one)));
  }

  #vehicle(one) {
    const names = one.proposal.send.map((image) => image.name).join(", ");
    const may = state.session.may.request;
    return h("article", { class: "card", "aria-label": t("airtime_panel.vehicle", { vehicle: one.vehicle_id }) },
      h("h3", { text: one.vehicle_id }),
      h("p", { class: "muted", text: t(`airtime_panel.basis_${one.basis}`) }),
      names ? h("p", {}, t("airtime_panel.proposal", { seconds: duration(one.proposal.horizon_s), names }), " ",
        h("button", { type: "button", class: "apply", disabled: !may, text: t("airtime_panel.apply"), on: { click: () => this.#apply(one.proposal.send) } })) : null,
      one.images.length ? h("table", {},
        h("thead", {}, h("tr", {}, ["image", "left", "cost", "gain", "order"].map((name) => h("th", { scope: "col", text: t(`airtime_panel.${name}`) })))),
        h("tbody", {}, one.images.map((image, place) => this.#row(image, place, one.images, may)))) : h("p", { class: "muted", text: t("airtime_panel.empty") }));
  }

  #row(image, place, images, may) {
    const send = (where) => h("button", { type: "button", disabled: !may, data: { place: where }, "aria-label": t(`airtime_panel.${where}_label`, { name: image.name }), text: t(`airtime_panel.${where}`), on: { click: () => this.#send([image], where) } });
    return h("tr", { draggable: may ? "true" : null, data: { id: image.id }, on: {
      dragstart: () => { this.dragged = image; },
      dragend: () => { this.dragged = null; },
      dragover: (event) => { if (this.dragged) event.preventDefault(); },
      // The link has two places: the front and the end.
      drop: (event) => { event.preventDefault(); this.#send([this.dragged], place < images.length / 2 ? "first" : "last"); },
    } },
    h("td", { text: image.name }), h("td", { class: "number", text: bytes(image.bytes_left) }), h("td", { class: "number", text: duration(image.cost_s) }),
    h("td", { class: "number", text: t("airtime_panel.gain_value", { value: (1000 * image.gain_per_s).toFixed(1) }) }), h("td", {}, send("first"), " ", send("last")));
  }

  /** The image that is sent first is requested last: each request moves its image to the front. */
  async #apply(images) { await this.#send([...images].reverse(), "first"); }

  async #send(images, place) {
    if (this.busy) return;
    this.busy = true;
    try {
      for (const image of images) await api.request(image.id, { kind: "prioritise", place });
      toast(t(`airtime_panel.sent_${place}`, { names: images.map((image) => image.name).join(", ") }));
    } catch (error) {
      toast(error.message, { bad: true });
    } finally {
      this.busy = false;
      this.dragged = null;
    }
    await this.refresh();
  }
}
