// Beside the decision: advice, what was asked for, measurements, other looks, the record and the audit.

import { fill, h } from "./dom.js";
import { decisionWords } from "./decision.js";
import { api } from "./api.js";
import { DASH, duration, position, quantity, received, time, verdict } from "./format.js";
import { lineOf } from "./measure.js";
import { tell } from "./state.js";

const section = (name, title, count, children, open = true) => h("details", { data: { name }, open },
  h("summary", { text: count ? `${title} (${count})` : title }), children);

function adviceList(advice) {
  return h("ul", {}, advice.map((one) => h("li", { class: "advice" },
    h("p", {}, h("b", { text: one.author }), ` ${time(one.advised_utc_s)}, on version ${one.version}`),
    one.verdict || one.mlo_class ? h("p", {}, h("b", { text: one.verdict ? decisionWords(one) : one.mlo_class })) : null,
    one.remark ? h("p", { text: one.remark }) : null,
    one.delivery ? h("p", { class: "muted", text: `to the vessel: ${one.delivery.state} ${one.delivery.reason}` }) : null)));
}

const REQUEST_WORDS = {
  waiting: "waiting on this platform", asked: "waiting for the water", sent: "in the water", confirmed: "the vehicle has it",
  refused: "refused", expired: "not confirmed in time", delivered: "on the vessel",
};

function requestList(requests) {
  return h("ul", {}, requests.map((one) => h("li", {},
    h("p", {}, h("b", { text: one.kind }), ` ${time(one.asked_utc_s)} by ${one.user}, ${one.airtime_s === null ? "cost not known" : `≈ ${duration(one.airtime_s)} of air`}`),
    h("p", { class: ["refused", "expired"].includes(one.state) ? "bad" : one.state === "confirmed" ? "good" : "" },
      `${REQUEST_WORDS[one.state] ?? one.state}${one.times_sent ? `, sent ${one.times_sent}×` : ""}${one.reason ? `: ${one.reason}` : ""}`))));
}

function measurementList(measurements) {
  return h("ul", {}, measurements.map((one) => h("li", {},
    h("p", {}, h("b", { text: lineOf(one).words })),
    one.height_inputs ? h("p", { class: "muted number", text: `height = shadow × altitude / (slant range + shadow), with ${quantity(one.height_inputs.altitude_m, "m")} and ${quantity(one.height_inputs.slant_range_m, "m")}` }) : null,
    one.note ? h("p", { class: "muted", text: one.note }) : null,
    h("p", { class: "muted", text: `${one.user}, ${time(one.utc_s)}, version ${one.version}, ${one.layer}` }))));
}

function looks(group, id) {
  return h("ul", {}, group.filter((row) => row.id !== id).map((row) => h("li", {},
    h("button", { type: "button", class: "look", on: { click: () => tell("select", { id: row.id }) } },
      row.has_picture ? h("img", { src: row.thumbnail, alt: "" }) : null,
      h("span", {}, h("b", { text: row.name }), ` ${verdict(row.review)}, ${received(row)} received, ${time(row.seen_utc_s ?? row.first_frame_utc_s)}`)))));
}

function facts(contact, record) {
  const r = record ?? {};
  const rows = [
    ["position", position(contact.lat_deg, contact.lon_deg)], ["seen", time(contact.seen_utc_s, { date: true })],
    ["detector", [r.atd_class, contact.atd_confidence === null ? null : `${contact.atd_confidence.toFixed(2)} of 2`].filter(Boolean).join(", ") || DASH],
    ["detector's size", [quantity(r.length_m, "m"), quantity(r.width_m, "m")].join(" × ")], ["detector's shadow, height", `${quantity(r.shadow_m, "m")}, ${quantity(r.height_m, "m")}`],
    ["slant, ground range", `${quantity(r.slant_range_m, "m")}, ${quantity(r.ground_range_m, "m")}`], ["altitude, depth", `${quantity(r.altitude_m, "m")}, ${quantity(r.depth_m, "m")}`],
    ["heading, speed", `${quantity(r.heading_deg, "°", 0)}, ${quantity(r.speed_mps, "m/s")}`], ["side", r.channel ?? DASH], ["pixel along × across", `${quantity(r.pixel_along_m, "m", 3)} × ${quantity(r.pixel_across_m, "m", 3)}`],
    ["line, ping", `${r.line_name ?? DASH}, ${r.ping_number ?? DASH}`], ["sonar", r.sonar_id ?? DASH], ["identifier", contact.id],
  ];
  return h("dl", { class: "facts number" }, rows.map(([name, value]) => [h("dt", { text: name }), h("dd", { text: value })]));
}

function auditList(audit) {
  return h("ul", {}, audit.slice().reverse().map((one) => h("li", {},
    h("p", {}, h("b", { text: `${one.action}` }), ` ${time(one.utc_s, { date: true })}, ${one.user} (${one.role}), ${one.address}`),
    one.version === null ? null : h("p", { class: "muted" }, `on the screen: version ${one.version}, ${one.layer ?? "raw"}, `, h("code", { text: (one.sha256 ?? "").slice(0, 12) })))));
}

export class Aside {
  constructor() {
    this.element = h("div", { class: "aside" });
    this.open = new Map([["record", false], ["audit", false]]);
    this.element.addEventListener("toggle", (event) => this.open.set(event.target.dataset.name, event.target.open), true);
  }

  show(detail) {
    const focused = document.activeElement?.closest?.(".aside details")?.dataset.name;
    this.#fill(detail);
    if (focused) this.element.querySelector(`details[data-name="${CSS.escape(focused)}"] > summary`)?.focus();
  }

  #fill({ contact, record, advice, requests, measurements, group, audit, decisions }) {
    const part = (name, title, list, make) => (list.length ? section(name, title, list.length, make(list), this.open.get(name) ?? true) : null);
    fill(this.element,
      part("advice", "Advice from shore", advice, adviceList),
      part("requests", "Asked for", requests, requestList),
      part("measurements", "Measurements", measurements, measurementList),
      contact.looks > 1 ? section("looks", "Other looks at this place", contact.looks - 1, looks(group, contact.id), this.open.get("looks") ?? true) : null,
      decisions.length > 1 ? section("decisions", "Decisions", decisions.length, h("ul", {}, decisions.map((one) => h("li", {}, h("p", {
        class: one.undone ? "undone" : "", text: `${one.undoes ? "undo: " : ""}${decisionWords(one)} — ${one.operator}, ${time(one.decided_utc_s)}`,
      })))), this.open.get("decisions") ?? false) : null,
      section("record", "Contact record", 0, facts(contact, record), this.open.get("record")),
      section("audit", "Audit", audit.length, auditList(audit), this.open.get("audit")),
      h("p", {}, h("a", { href: api.reportUrl(contact.id), target: "_blank", rel: "noopener" }, "printable report")));
  }
}
