// Details beside the decision: comments, requests, measurements, other looks, contact record, audit.

import { api } from "../base/api.js";
import { decisionText } from "../decision/decision_form.js";
import { fill, h } from "../base/dom.js";
import { DASH, authentication, className, layerName, position, probabilities, probability, quantity, received, time, verdict } from "../base/format.js";
import { measurementLine } from "../image/measurement.js";
import { openObject } from "../views/object_view.js";
import { requestState, requestTitle } from "../requests/request_state.js";
import { emit, now, state } from "../base/state.js";
import { t } from "../texts.js";

const section = (name, title, count, children, open = true) => h("details", { data: { name }, open },
  h("summary", { text: count ? `${title} (${count})` : title }), children);

function commentList(comments) {
  return h("ul", {}, comments.map((one) => h("li", { class: "comment" },
    h("p", {}, h("b", { text: one.author }), ` ${t("contact_details.on_version", { time: time(one.commented_utc_s), version: one.version })}`),
    one.verdict || one.mlo_class ? h("p", {}, h("b", { text: one.verdict ? decisionText(one) : one.mlo_class })) : null,
    one.remark ? h("p", { text: one.remark }) : null,
    one.delivery ? h("p", { class: "muted", text: t("contact_details.to_vessel", { state: t(`contact_details.delivery.${one.delivery.state}`), reason: one.delivery.reason }) }) : null)));
}

function requestList(/** @type {VehicleRequest[]} */ requests, vehicle) {
  return h("ul", {}, requests.map((one) => {
    const { kind, detail } = requestTitle(one);
    const { text, tone } = requestState(one, vehicle, now());
    return h("li", {}, h("p", {}, h("b", { text: kind }), ` ${detail}`), h("p", { class: tone, text }));
  }));
}

function measurementList(measurements) {
  return h("ul", {}, measurements.map((one) => h("li", { class: one.withdrawn_utc_s === null ? "" : "undone" },
    h("p", {}, h("b", { text: measurementLine(one).text })),
    one.height_inputs ? h("p", { class: "muted number", text: t("contact_details.height_formula", { altitude: quantity(one.height_inputs.altitude_m, "m"), range: quantity(one.height_inputs.slant_range_m, "m") }) }) : null,
    h("p", { class: "muted", text: t("contact_details.measured_by", { user: one.user, time: time(one.utc_s), version: one.version, layer: layerName(null, one.layer) }) }))));
}

function lookList(group, id) {
  return h("ul", {}, group.filter((row) => row.id !== id).map((row) => h("li", {},
    h("button", { type: "button", class: "look", on: { click: () => emit("select", { id: row.id }) } },
      row.has_image ? h("img", { src: api.thumbnailUrl(row.id, row.version), alt: "" }) : null,
      h("span", {}, h("b", { text: row.name }), ` ${verdict(row.review)}, ${received(row)}, ${time(row.seen_utc_s ?? row.first_frame_utc_s, { date: true })}`)))));
}

function decisionList(decisions) {
  return h("ul", {}, decisions.map((one) => h("li", {}, h("p", {
    class: one.undone ? "undone" : "", text: `${one.undoes ? "undo: " : ""}${decisionText(one)} — ${one.operator}, ${time(one.decided_utc_s)}`,
  }))));
}

function recordFacts(/** @type {Contact} */ contact, record, further) {
  const r = record ?? {};
  const rows = [
    ["position", position(contact.lat_deg, contact.lon_deg)], ["detected", time(contact.seen_utc_s, { date: true })],
    ["detector", [contact.atd_class && className(contact.atd_class), probabilities(contact) ?? probability(contact)].filter(Boolean).join(", ") || DASH],
    ["size", [quantity(r.length_m, "m"), quantity(r.width_m, "m")].join(" × ")], ["shadow", `${quantity(r.shadow_m, "m")}, ${quantity(r.height_m, "m")}`],
    ["range", `${quantity(r.slant_range_m, "m")}, ${quantity(r.ground_range_m, "m")}`], ["altitude", `${quantity(r.altitude_m, "m")}, ${quantity(r.depth_m, "m")}`],
    ["heading", `${quantity(r.heading_deg, "°", 0)}, ${quantity(r.speed_mps, "m/s")}`], ["side", r.channel ?? DASH], ["pixel", `${quantity(r.pixel_along_m, "m", 3)} × ${quantity(r.pixel_across_m, "m", 3)}`],
    ["line", `${r.line_name ?? DASH}, ${r.ping_number ?? DASH}`], ["sonar", r.sonar_id ?? DASH], ["frames", authentication(contact) ?? DASH], ["id", contact.id],
  ];
  return h("dl", { class: "facts number" }, rows.map(([name, value]) => [h("dt", { text: t(`contact_details.fact.${name}`) }), h("dd", { text: value })]),
    Object.entries(further).map(([name, value]) => [h("dt", { text: name }), h("dd", { text: String(value) })]));
}

function auditList(audit) {
  return h("ul", {}, audit.slice().reverse().map((one) => h("li", {},
    h("p", {}, h("b", { text: `${one.action}` }), ` ${time(one.utc_s, { date: true })}, ${one.user} (${one.role}), ${one.address}`),
    one.version === null ? null : h("p", { class: "muted" }, `${t("contact_details.displayed", { version: one.version, layer: layerName(null, one.layer ?? "raw") })} `, h("code", { text: (one.sha256 ?? "").slice(0, 12) })))));
}

export class ContactDetails {
  constructor() {
    this.element = h("div", { class: "details" });
    this.open = new Map([["record", false], ["audit", false]]);
    this.element.addEventListener("toggle", (event) => this.open.set(event.target.dataset.name, event.target.open), true);
  }

  show(/** @type {ContactDetail} */ detail) {
    const focused = document.activeElement?.closest?.(".details details")?.dataset.name;
    this.#render(detail);
    if (focused) this.element.querySelector(`details[data-name="${CSS.escape(focused)}"] > summary`)?.focus();
  }

  #render({ contact, record, further, comments, requests, measurements, group, earlier, audit, decisions }) {
    const part = (name, title, count, make, open = true) => (count > 0 ? section(name, title, count, make(), this.open.get(name) ?? open) : null);
    fill(this.element,
      // Before a decision on the vessel, comments are folded, so that they do not influence it.
      part("comments", t("contact_details.comments"), comments.length, () => commentList(comments), state.info.side === "shore" || contact.review !== "unreviewed"),
      part("requests", t("contact_details.requests"), requests.length, () => requestList(requests, contact.vehicle_id)),
      part("measurements", t("contact_details.measurements"), measurements.length, () => measurementList(measurements)),
      part("looks", t("contact_details.looks"), contact.looks - 1, () => lookList(group, contact.id)),
      part("earlier", t("object.earlier"), earlier.length, () => lookList(earlier, contact.id)),
      decisions.length > 1 ? section("decisions", t("contact_details.decisions"), decisions.length, decisionList(decisions), this.open.get("decisions") ?? false) : null,
      section("record", t("contact_details.record"), 0, recordFacts(contact, record, further), this.open.get("record")),
      section("audit", t("contact_details.audit"), audit.length, auditList(audit), this.open.get("audit")),
      contact.object === null ? null : h("p", {}, h("button", { type: "button", class: "open-object", text: t("object.key"), on: { click: () => openObject(contact) } })),
      h("p", {}, h("a", { href: api.reportUrl(contact.id), target: "_blank", rel: "noopener" }, t("contact_details.report"))));
  }
}
